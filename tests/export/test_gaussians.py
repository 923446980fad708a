"""Files of Gaussians by their suffix, and what is particular to safetensors."""

from dataclasses import fields, replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from asysplat import read_gaussians, write_gaussians
from asysplat.errors import InputError
from asysplat.export import read_safetensors, write_safetensors
from asysplat.export.gaussians import WRITERS, Notes, read_notes
from asysplat.export.page import PAGE
from asysplat.scene import Gaussians

READABLE = [suffix for suffix in WRITERS if suffix != PAGE]


@pytest.fixture
def scene(make_scene):
    return make_scene(degree=2, dtype=torch.float32)[0]


def test_other_suffixes_are_refused(scene, tmp_path):
    for name in ("scene.obj", "scene"):
        with pytest.raises(InputError, match=rf"{name} cannot be written.*\.spz, .* or \.html"):
            write_gaussians(tmp_path / name, scene)
        with pytest.raises(InputError, match=rf"{name} cannot be read.*expected \.ply, \.spz"):
            read_gaussians(tmp_path / name)


@pytest.mark.parametrize("suffix", READABLE)
def test_every_format_that_is_written_is_read(scene, tmp_path, suffix):
    write_gaussians(tmp_path / f"a scene{suffix}", scene)
    assert read_gaussians(tmp_path / f"a scene{suffix}").num_gaussians == scene.num_gaussians


@pytest.mark.parametrize("suffix", READABLE)
def test_half_a_file_is_a_sentence_that_names_it(scene, tmp_path, suffix):
    file = tmp_path / f"scene{suffix}"
    write_gaussians(file, scene)
    content = file.read_bytes()
    for half in (content[: len(content) // 2 + 1], b""):
        file.write_bytes(half)
        with pytest.raises(InputError, match=f"scene{suffix}"):
            read_gaussians(file)


@pytest.mark.parametrize("suffix", READABLE)
def test_notes_are_kept_where_there_is_a_place(scene, tmp_path, suffix):
    notes = Notes((1e7, -2.5, 0.1), (0.25, 0.5, 1.0), antialiased=True)
    file = tmp_path / f"scene{suffix}"
    write_gaussians(file, scene, notes)
    numbers, flag = suffix in (".ply", ".safetensors"), suffix not in (".glb", ".splat")
    kept = (notes if numbers else Notes())._replace(antialiased=flag)
    assert read_notes(file) == kept
    write_gaussians(file, scene)
    assert read_notes(file) == Notes()


@pytest.mark.parametrize("name", ["scene.ply", "scene.safetensors"])
def test_what_cannot_be_rendered_is_not_written_over_a_file(scene, tmp_path, name):
    file = tmp_path / name
    with pytest.raises(InputError, match=rf"{name} is not a file"):
        read_gaussians(file)
    file.write_text("old")
    for bad, message in (
        (replace(scene, scales=-scene.scales), r"scales\[0\] is <= 0"),
        (scene.keep(scene.opacities > 2), "no Gaussians"),
        (Gaussians.stack([scene, scene]), "one by one"),
    ):
        with pytest.raises(InputError, match=message):
            write_gaussians(file, bad)
        assert file.read_text() == "old"


@pytest.fixture
def written(scene, tmp_path):
    write_safetensors(tmp_path / "scene.safetensors", scene, {"unit": "meters"})
    return tmp_path / "scene.safetensors"


def test_all_bits_of_safetensors_come_back(written, scene, make_scene):
    read, metadata = read_safetensors(written)
    double, double_file = make_scene(degree=1)[0], written.with_name("double.safetensors")
    write_safetensors(double_file, double, dtype=torch.float64)
    with_bits = read_gaussians(double_file, (0.0, 0.0, 0.0), torch.float64)
    for field in fields(Gaussians):
        assert torch.equal(getattr(read, field.name), getattr(scene, field.name))
        assert torch.equal(getattr(with_bits, field.name), getattr(double, field.name))
    assert metadata == {"unit": "meters"}
    assert set(load_file(written)) == {field.name for field in fields(Gaussians)}
    assert read_gaussians(double_file).means.dtype == torch.float32


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
        ({"scales": None}, "no scales: expected the fields means, quats, scales"),
        ({"means": torch.full((12, 3), torch.nan)}, r"Gaussians\.means\[0\] holds NaN"),
    ],
)
def test_safetensors_that_hold_no_scene_are_refused(written, tensors, message):
    change(written, **tensors)
    with pytest.raises(InputError, match=rf"scene\.safetensors.*{message}"):
        read_safetensors(written)
