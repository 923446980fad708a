"""Several test sets are tested in one run: each has the same numbers as alone."""

import warnings
from types import SimpleNamespace

import lightning
import pytest
import torch
from hydra.utils import instantiate
from tiny import NETWORK, QUIET, SCENES, VIEWS

from asysplat.training.callbacks import Figures, Metrics
from asysplat.training.callbacks.metrics import gather

pytestmark = pytest.mark.medium

TINY = [*NETWORK, *VIEWS, *SCENES, "paths.run=unused"]


@pytest.fixture(scope="module")
def measure(composed, tmp_path_factory):
    """The test of an untrained model: its results and folder."""

    def run(*overrides):
        config = composed(*TINY, *overrides)
        torch.manual_seed(0)
        module = instantiate(config.training, net=instantiate(config.model))
        folder = tmp_path_factory.mktemp("run")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            metrics = Metrics(instantiate(config.metrics), str(folder), backbone_dir=str(folder))
            callbacks = [metrics, Figures(str(folder), scenes=2)]
            trainer = lightning.Trainer(**QUIET, callbacks=callbacks)
            trainer.test(module, instantiate(config.data), verbose=False)
        return SimpleNamespace(results=metrics.results, folder=folder)

    return run


MORE_SETS = [
    "+data.test_sets.more_views={inputs: 5, test_scenes: 2}",
    "+data.test_sets.wide={width: 64}",
]


@pytest.fixture(scope="module")
def together(measure):
    return measure(*MORE_SETS)


ALONE = {
    "procedural": [],
    "rooms": ["data.places=rooms"],
    "more_views": ["data.inputs=5", "data.test_scenes=2"],
    "wide": ["data.width=64"],
}


@pytest.mark.parametrize("name", ALONE)
def test_a_set_has_the_same_numbers_as_alone(measure, together, name):
    run = measure("data.test_sets=null", f"data.name={name}", *ALONE[name])
    expected = run.results
    assert {f"test/{name}/psnr", f"baseline/{name}/nearest_view/ssim"} <= expected.keys()
    alone, among_others = (
        {key: value for key, value in results.items() if key.split("/")[1] == name}
        for results in (expected, together.results)
    )
    assert among_others == alone
    drawn_alone = run.folder / "figures" / "test-0.png"
    suffix = "" if name == "procedural" else f"-{name}"  # further sets have their name
    drawn = together.folder / "figures" / f"test{suffix}-0.png"
    assert drawn.read_bytes() == drawn_alone.read_bytes()


def test_processes_count_an_image_once_in_each_set(monkeypatch):
    def row(test_set, scene, psnr):
        return {"set": test_set, "scene": scene, "view": 0, "psnr": psnr}

    mine = [row("main", "a", 10.0), row("more_views", "a", 20.0)]
    theirs = [row("main", "b", 30.0), row("more_views", "a", 20.0)]

    def all_gather_object(into, _):
        into[:] = [mine, theirs]

    monkeypatch.setattr(torch.distributed, "all_gather_object", all_gather_object)
    monkeypatch.setattr(lightning.Trainer, "world_size", 2)
    assert gather(lightning.Trainer.__new__(lightning.Trainer), mine) == [*mine, theirs[0]]
