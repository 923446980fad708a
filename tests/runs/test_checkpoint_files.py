"""Which checkpoint a run resumes or starts from; damaged ones are detected."""

import struct
import zipfile

import pytest
import torch
from safetensors.torch import save_file

from asysplat.errors import InputError
from asysplat.runs.checkpoints import atomic_save, config_diff, find_checkpoint, load_weights


@pytest.fixture
def run(tmp_path):
    """The folder of a run that was cut off."""
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    for name in ("previous", "last"):
        state = {"state_dict": torch.nn.Linear(2, 1).state_dict()}
        atomic_save(state, tmp_path / "run" / "checkpoints" / f"{name}.ckpt")
    return tmp_path / "run"


def damage(path):
    """Change one bit of the weights, which torch does not detect."""
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as parts:
        (part,) = (each for each in parts.infolist() if each.filename.endswith("/data/0"))
    lengths = struct.unpack_from("<HH", content, part.header_offset + 26)  # name, extra field
    content[part.header_offset + 30 + sum(lengths)] ^= 1
    path.write_bytes(content)


def test_a_damaged_checkpoint_is_replaced_by_the_one_before(tmp_path, run):
    last, previous = (run / "checkpoints" / f"{name}.ckpt" for name in ("last", "previous"))
    assert find_checkpoint("last", tmp_path / "new", tmp_path) == last
    assert find_checkpoint(None, tmp_path / "new", tmp_path) is None
    assert find_checkpoint(None, run, tmp_path) == last  # a run that was cut off
    whole = last.read_bytes()
    last.write_bytes(whole[: len(whole) // 2])
    for asked in ("last", str(last)):
        said = []
        assert find_checkpoint(asked, tmp_path / "new", tmp_path, say=said.append) == previous
        assert said == [
            f"{last} cannot be read as a checkpoint: resuming from the one before it",
            f"resuming from {previous}",
        ]
    last.unlink()
    assert find_checkpoint("last", tmp_path / "new", tmp_path) == previous
    previous.write_bytes(whole[:100])
    with pytest.raises(InputError, match=r"ckpt_path=\S+last\.ckpt does not exist: name a \.ckpt"):
        find_checkpoint("last", tmp_path / "new", tmp_path)


def test_a_changed_bit_is_detected(tmp_path, run, capsys):
    damage(run / "checkpoints" / "last.ckpt")
    found = find_checkpoint("last", tmp_path / "new", tmp_path)
    assert found == run / "checkpoints" / "previous.ckpt"
    assert "last.ckpt is damaged, at " in capsys.readouterr().out
    damage(found)
    with pytest.raises(InputError, match=r"last\.ckpt is damaged, at archive/data/0: "):
        find_checkpoint("last", tmp_path / "new", tmp_path)


def test_checkpoints_that_are_none_are_named(tmp_path, repository):
    text = str(repository / "README.md")
    with pytest.raises(InputError, match=r"README\.md cannot be read as a checkpoint"):
        find_checkpoint(text, tmp_path / "new", tmp_path)
    with pytest.raises(InputError, match=r"ckpt_path=last found no .* leave ckpt_path out"):
        find_checkpoint("last", tmp_path / "new", tmp_path)


def test_options_that_differ_from_a_checkpoint_s_are_listed():
    notes = {"revision": "a", "hyper_parameters": {"steps": 6, "data": {"seed": 1, "root": "x"}}}
    assert config_diff(notes, notes["hyper_parameters"] | {"ckpt_path": "last"}, "a") == []
    options = {"steps": 9, "data": {"seed": 2, "root": "x"}, "paths": {"logs": "y"}}
    assert config_diff(notes, options, "b") == [
        "data.seed=2, it was 1",
        "steps=9, it was 6",
        "the code is b, it was a",
    ]


def test_weights_in_half_precision_are_loaded(tmp_path):
    def make():
        return torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))

    net, again = make(), make()
    state = {n: t.half() if t.is_floating_point() else t for n, t in net.state_dict().items()}
    save_file(state, tmp_path / "net.safetensors")
    load_weights(str(tmp_path / "net.safetensors"), again)
    for name, tensor in again.state_dict().items():
        torch.testing.assert_close(tensor, net.state_dict()[name], rtol=1e-3, atol=1e-6)
        assert tensor.dtype == net.state_dict()[name].dtype
    with pytest.raises(InputError, match=r"0\.bias is \(2,\) there and \(3,\) here"):
        load_weights(str(tmp_path / "net.safetensors"), torch.nn.Sequential(torch.nn.Linear(3, 3)))
