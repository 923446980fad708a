"""The configuration of a run from another machine builds the classes of conf/ and no others."""

from pathlib import Path

import pytest
import yaml

from asysplat import load
from asysplat.errors import InputError
from asysplat.runs.run_config import read_config

OLD_RUN = Path(__file__).parent / "old_run"
TARGETS = "os.system subprocess.run builtins.eval builtins.exec builtins.__import__ pickle.loads"
TARGETS += " sympy.sympify torch.load joblib.load numpy.load shutil.rmtree runpy.run_path"
TARGETS += " importlib.import_module hydra.utils.get_method hydra.utils.instantiate torch.hub.load"
TARGETS += " asysplat.runs.checkpoints.torch.load asysplat.load omegaconf.OmegaConf.load"
TARGETS += " lightning.pytorch.cli.LightningCLI path:os.system"
TARGETS += " torch.nn.Identity.__init__.__globals__"


@pytest.fixture
def run(tmp_path):
    """Write a run folder with another configuration; return its checkpoint."""
    content = yaml.safe_load((OLD_RUN / "config.yaml").read_text())

    def write(change):
        change(content)
        (tmp_path / "config.yaml").write_text(yaml.safe_dump(content))
        (tmp_path / "checkpoints").mkdir()
        return (tmp_path / "checkpoints" / "last.ckpt").absolute()

    return write


@pytest.mark.medium
@pytest.mark.parametrize("key", ["head", "prior", "_args_"])
@pytest.mark.parametrize("target", TARGETS.split())
def test_no_other_class_is_built(run, tmp_path, target, key):
    called = {"_target_": target, "a": f"open({str(tmp_path / 'written')!r}, 'w')"}
    file = run(lambda content: content["model"].update({key: [called]}))
    file.touch()
    with pytest.raises(InputError, match="no file of conf/model/ names"):
        load(str(file))
    assert not (tmp_path / "written").exists()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("${oc.decode:'{_target_: os.system}'}", "no interpolations"),
        ("\\${oc.decode:'{_target_: os.system}'}", "no interpolations"),
        ({"_target_": "${model.name}"}, "no interpolations|no file of conf/"),
        ({"_target_": ["os.system"]}, "no file of conf/model"),
        ({"_target_": {"a": 1}}, "no file of conf/model"),
    ],
)
def test_a_target_cannot_be_hidden(run, value, message):
    file = run(lambda content: content["model"].update(head=value))
    with pytest.raises(InputError, match=message):
        read_config(file.parents[1] / "config.yaml")


def test_a_model_holds_only_parts_of_models(tmp_path):
    """One with a data set would read all of a disk, one with a logger would write."""
    scenes, file = {"_target_": "asysplat.data.files_data", "root": "/"}, tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump({"model": {"prior": scenes}}))
    with pytest.raises(InputError, match="files_data', which no file of conf/model/ names"):
        read_config(file)
    file.write_text(yaml.safe_dump({"data": scenes}))
    assert read_config(file).data == scenes


BOMB = "a0: &a0 [1, 2]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40))
HUGE = {
    "aliases": (BOMB, "aliases make more than 100,000 values"),
    "itself": ("a: &a [1, *a]", "aliases make more than 100,000 values"),
    "bytes": ("a: " + "1" * 2**20, "at most 1,048,576 are expected"),
    "digits": ("a: " + "1" * 5000, "digits"),
    "depth": ("[" * 5000, "cannot be read"),
}


@pytest.mark.parametrize(("content", "message"), HUGE.values(), ids=HUGE)
def test_a_configuration_that_is_too_large_is_refused(tmp_path, content, message):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(InputError, match=message):
        read_config(tmp_path / "config.yaml")


def test_caches_and_downloads_are_not_the_runs(run, tmp_path):
    cache = {"_target_": "asysplat.data.ImageCache", "folder": str(tmp_path), "disk_gb": 0}

    def change(content):
        content["data"]["cache"] = cache
        content["training"]["loss"]["more"] = [{"download": True}]

    config = read_config(run(change).parents[1] / "config.yaml")
    assert config.data.cache is None
    assert config.training.loss.more[0].download is False


def test_values_without_names_are_refused(run):
    """As they could be a cache or a download."""
    vgg16 = {"_target_": "asysplat.training.losses.perceptual.vgg16", "_args_": [None, True]}
    file = run(lambda content: content["training"]["loss"].update(perceptual_distance=vgg16))
    with pytest.raises(InputError, match=r"perceptual_distance\._args_: a run's configuration"):
        read_config(file.parents[1] / "config.yaml")


@pytest.mark.parametrize("content", ["[1, 2]", "a: {", "1", "", "a: !!python/object:os.system {}"])
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(InputError, match=r"config\.yaml"):
        read_config(tmp_path / "config.yaml")
