from dataclasses import fields

import pytest
import torch
from safetensors.torch import load_file, save_file

from asysplat.errors import InputError
from asysplat.export import read_safetensors, write_safetensors
from asysplat.scene import Gaussians


@pytest.fixture
def scene(make_scene):
    return make_scene(degree=2, dtype=torch.float32)[0]


@pytest.fixture
def written(scene, tmp_path):
    write_safetensors(tmp_path / "scene.safetensors", scene, {"unit": "meters"})
    return tmp_path / "scene.safetensors"


def test_all_bits_come_back(written, scene):
    read, metadata = read_safetensors(written)
    for field in fields(Gaussians):
        assert torch.equal(getattr(read, field.name), getattr(scene, field.name))
    assert metadata == {"unit": "meters"}
    assert set(load_file(written)) == {field.name for field in fields(Gaussians)}


def test_views_of_other_types_with_gradients_are_written(make_scene, tmp_path):
    scene, _ = make_scene(dtype=torch.float64)
    scene = scene.map(lambda tensor: torch.stack((tensor, tensor), -1)[..., 0].requires_grad_())
    write_safetensors(tmp_path / "scene.safetensors", scene)
    read, metadata = read_safetensors(tmp_path / "scene.safetensors")
    assert torch.equal(read.sh, scene.sh.float()) and not read.sh.requires_grad and metadata == {}


def change(file, **tensors):
    content = load_file(file) | tensors
    save_file({name: tensor for name, tensor in content.items() if tensor is not None}, file)


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"scales": None}, "has no scales: expected the fields means, quats, scales"),
        ({"sh": torch.zeros(12, 5, 3)}, r"Gaussians\.sh has 5 coefficients"),
        ({"means": torch.full((12, 3), torch.nan)}, r"Gaussians\.means\[0\] holds NaN"),
        ({"opacities": torch.full((12,), 2.0)}, r"Gaussians\.opacities\[0\] lies outside"),
    ],
)
def test_scenes_that_cannot_be_used_are_refused(written, tensors, message):
    change(written, **tensors)
    with pytest.raises(InputError, match=rf"scene\.safetensors.*{message}"):
        read_safetensors(written)


def test_one_scene_and_not_none_is_read(written, scene):
    for bad in (scene.keep(scene.opacities > 2), scene.stack([scene, scene])):
        change(written, **{f.name: getattr(bad, f.name) for f in fields(Gaussians)})
        with pytest.raises(InputError, match=r"scene\.safetensors has opacities of shape .*\[N\]"):
            read_safetensors(written)


@pytest.mark.parametrize("size", [0, 7, 100, -1])
def test_files_that_are_cut_off_are_refused(written, size):
    written.write_bytes(written.read_bytes()[:size])
    with pytest.raises(InputError, match=r"scene\.safetensors cannot be read as safetensors"):
        read_safetensors(written)
