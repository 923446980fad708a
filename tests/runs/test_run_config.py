"""The configuration of a run builds the classes of conf/ and no others."""

import pytest
import yaml

from asysplat import load
from asysplat.errors import InputError
from asysplat.runs.run_config import read_config


@pytest.fixture
def run(tmp_path, composed):
    """Write a run folder whose model has another head; return its configuration."""

    def write(head):
        model = {"_target_": "asysplat.models.build_asysplat", "head": head}
        (tmp_path / "config.yaml").write_text(yaml.safe_dump({"model": model}))
        return tmp_path / "config.yaml"

    return write


@pytest.mark.parametrize("target", ["os.system", "hydra.utils.get_method"])
def test_no_other_class_is_built(run, tmp_path, target):
    called = {"_target_": target, "a": f"open({str(tmp_path / 'written')!r}, 'w')"}
    config = run([called])
    (tmp_path / "checkpoints").mkdir()
    checkpoint = tmp_path / "checkpoints" / "last.ckpt"
    checkpoint.touch()
    with pytest.raises(InputError, match=r"model\.head\.0\._target_ .* no file of conf/ names"):
        load(str(checkpoint))
    assert not (tmp_path / "written").exists()
    assert config.exists()


def test_a_target_cannot_be_hidden(run):
    with pytest.raises(InputError, match=r"model\.head\._target_ is os\.system"):
        read_config(run("${oc.decode:'{_target_: os.system}'}"))


@pytest.mark.parametrize("content", ["[1, 2]", "a: {"])
def test_a_file_that_is_no_configuration_is_named(tmp_path, content):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(InputError, match=r"config\.yaml"):
        read_config(tmp_path / "config.yaml")
