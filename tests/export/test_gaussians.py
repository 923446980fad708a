from dataclasses import fields, replace

import pytest
import torch
from full_disk import largest_file

from asysplat import read_gaussians, write_gaussians
from asysplat.errors import InputError
from asysplat.scene import Gaussians


@pytest.fixture
def scene(make_scene):
    return make_scene(degree=1, dtype=torch.float32)[0]


@pytest.mark.parametrize("name", ["scene.ply", "scene.safetensors", "SCENE.PLY"])
def test_the_suffix_names_the_format(scene, tmp_path, name):
    write_gaussians(tmp_path / name, scene)
    read = read_gaussians(str(tmp_path / name))
    for field in fields(Gaussians):
        if field.name != "quats":  # normalized in PLY
            torch.testing.assert_close(getattr(read, field.name), getattr(scene, field.name))


def test_splat_is_read_and_not_written(scene, tmp_path):
    (tmp_path / "scene.splat").write_bytes(bytes(24) + bytes([255] * 8))
    assert read_gaussians(tmp_path / "scene.splat").num_gaussians == 1
    with pytest.raises(InputError, match=r"scene\.splat cannot be written.*\.ply or \.safeten"):
        write_gaussians(tmp_path / "scene.splat", scene)


@pytest.mark.parametrize("name", ["scene.obj", "scene"])
def test_other_suffixes_are_refused(scene, tmp_path, name):
    with pytest.raises(InputError, match=rf"{name} cannot be read.*expected \.ply or \.splat or"):
        read_gaussians(tmp_path / name)
    with pytest.raises(InputError, match=rf"{name} cannot be written"):
        write_gaussians(tmp_path / name, scene)


@pytest.mark.parametrize("name", ["scene.ply", "scene.safetensors"])
def test_a_full_disk_leaves_the_old_file(scene, make_scene, tmp_path, name):
    file = tmp_path / name
    write_gaussians(file, scene)
    before = file.read_bytes()
    larger, _ = make_scene(count=200)
    message = rf"{name} cannot be written \(File too large\)"
    with largest_file(5000), pytest.raises(InputError, match=message):
        write_gaussians(file, larger)
    assert file.read_bytes() == before and list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", ["scene.ply", "scene.safetensors"])
def test_what_cannot_be_rendered_is_not_written_over_a_file(scene, tmp_path, name):
    file = tmp_path / name
    with pytest.raises(InputError, match=rf"{name} is not a file"):
        read_gaussians(file)
    file.write_text("old")
    for bad, message in (
        (replace(scene, scales=-scene.scales), r"scales\[0\] is <= 0"),
        (replace(scene, means=scene.means / 0), r"means\[0\] holds NaN or infinity"),
        (replace(scene, opacities=scene.opacities + 1), r"opacities\[0\] lies outside"),
        (scene.keep(scene.opacities > 2), "no Gaussians"),
        (Gaussians.stack([scene, scene]), "one by one"),
    ):
        with pytest.raises(InputError, match=message):
            write_gaussians(file, bad)
        assert file.read_text() == "old"
