"""The paper's test sets as sweeps name them, from tiny scenes as their publishers lay them out."""

import json

import pytest
from hydra.utils import instantiate
from layouts import colmap, dl3dv, realestate10k, replica

from asysplat.errors import InputError

TINY = ["data.inputs=4", "data.targets=2", "data.window=[8,12]", "data.val_scenes=1"]
TINY += ["data.height=16", "data.width=16", "data.num_workers=0"]


@pytest.fixture(scope="module")
def published(views, tmp_path_factory):
    """Overrides that say where each data set is."""
    root = tmp_path_factory.mktemp("published")
    for letter in "abc":
        dl3dv.write_scene(views, root / "DL3DV" / "1K" / (letter * 64))
    dl3dv.write_benchmark(views, root / "Benchmark")
    replica.write(views, root / "Replica")
    realestate10k.write(views, root / "re10k")
    index = {realestate10k.KEY: {"context": [1, 9], "target": [3, 5, 7]}}
    (root / "index.json").write_text(json.dumps(index))
    places = {"replica": "Replica", "realestate10k": "re10k"}
    places["realestate10k_index"] = "index.json"
    for name in ("tanks_and_temples", "mipnerf360", "deep_blending"):
        colmap.write(views, root / name / "place")
        places[name] = name
    overrides = [f"paths.{name}={root / place}" for name, place in places.items()]
    return [f"data.root={root / 'DL3DV'}", f"data.test_root={root / 'Benchmark'}", *overrides]


@pytest.fixture
def tests_of(composed, published):
    """Name -> its first scene, as a command's overrides have them."""

    def make(*overrides):
        data = instantiate(composed("data=dl3dv", *TINY, *published, *overrides).data)
        data.setup()
        return {name: tasks[0] for name, tasks in data.tests.items()}

    return make


def counts(sample):
    return sample["inputs"].num_views, sample["targets"].num_views


@pytest.mark.medium
def test_tables_2_and_3_test_their_zero_shot_sets(tests_of):
    tests = tests_of("sweeps=state_of_the_art", "replica_size.height=16", "replica_size.width=22")
    assert list(tests) == ["dl3dv", "tanks_and_temples", "mipnerf360", "deep_blending", "replica"]
    assert tests["dl3dv"]["scene"] == dl3dv.HASH
    for name, sample in tests.items():
        assert counts(sample) == (4, 2)  # every 8th of twelve is a target
        assert sample["prune"] == (name != "replica")
        size = (16, 22) if name == "replica" else (16, 16)
        assert sample["targets"].images.shape[-2:] == size
        assert (sample["targets"].cameras.height, sample["targets"].cameras.width) == size
    assert tests["replica"]["targets"].depths.shape[-2:] == (16, 22)
    only = "data.test_sets.replica.scenes"
    assert tests_of("test_sets=[replica]", f"{only}=[{tests['replica']['scene']}]")["replica"]
    with pytest.raises(InputError, match=r"replica: scenes names room9, and .* choose of"):
        tests_of("test_sets=[replica]", f"{only}=[room9]")


def test_table_5_tests_the_views_of_its_index(tests_of):
    tests = tests_of("sweeps=two_views", "test_sets=[realestate10k]", "data.inputs=3")
    assert counts(tests["realestate10k"]) == (2, 3) and counts(tests["dl3dv"]) == (3, 2)
