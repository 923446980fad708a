"""SPZ: what comes back, what is refused, and what another program reads."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import splat_transform

from asysplat.errors import InputError
from asysplat.export import read_ply, write_ply
from asysplat.export.formats.packing import half_turn, morton_order
from asysplat.export.formats.spz import encode_spz, read_spz, write_spz
from asysplat.geometry.motion import rotations
from asysplat.scene import Gaussians

VERSIONS = (2, 3, 4)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "scene.spz"


def in_file_order(scene):
    return scene.map(lambda field: field[morton_order(half_turn(scene, 0).means)])


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_scene_comes_back_within_the_precision_of_the_format(make_scene, file, version, degree):
    scene = in_file_order(make_scene(count=300, degree=degree, dtype=torch.float32)[0])
    write_spz(file, scene, version)
    read = read_spz(file)
    size = scene.scales.amax(1).quantile(0.01)
    assert (read.means - scene.means).abs().max() < size / 16
    assert (read.scales / scene.scales).log().abs().max() <= 1 / 32 + 1e-5
    assert (read.opacities - scene.opacities).abs().max() <= 0.5 / 255 + 1e-6
    steps = torch.tensor([0.5 / 255 / 0.15, *[1 / 32] * 3, *[1 / 16] * 12])[: (degree + 1) ** 2]
    inside = scene.sh.abs() < 0.9  # the format ends at 1
    assert ((read.sh - scene.sh).abs() <= steps[:, None] + 1e-5)[inside].all()
    angle = (rotations(read.quats).mT @ rotations(scene.quats)).diagonal(dim1=1, dim2=2).sum(1)
    limit = np.radians(12 if version == 2 else 0.3)  # version 2 derives a small w badly
    assert ((angle.clamp(max=3) - 1) / 2).clamp(-1, 1).acos().max() < limit


@pytest.mark.parametrize("version", VERSIONS)
def test_the_same_scene_gives_the_same_bytes(make_scene, version):
    scene, _ = make_scene(degree=2, dtype=torch.float32)
    assert encode_spz(scene, version) == encode_spz(scene, version)


def test_extremes_are_kept_or_limited(file):
    count = 4
    scene = Gaussians(
        means=torch.tensor([[0.0, 0, 0], [1, -2, 4], [-1000, 0, 0], [1023.9, 0, 0]]),
        quats=torch.eye(4),
        scales=torch.tensor([1e-10, 1e-3, 1, 1e4])[:, None].repeat(1, 3),
        opacities=torch.tensor([1e-6, 0.5, 1 - 1e-7, 1]),
        sh=torch.tensor([-9.0, 0, 9, 0.1])[:, None, None].repeat(1, 4, 3),
    )
    write_spz(file, scene)
    read, scene = read_spz(file), in_file_order(scene)
    assert read.num_gaussians == count
    assert (read.means - scene.means).abs().max() < 2e-4
    torch.testing.assert_close(
        read.scales.log(), scene.scales.log().clamp(-10, 255 / 16 - 10), atol=1 / 32, rtol=0
    )
    assert (read.opacities - scene.opacities).abs().max() < 0.003 and (read.opacities > 0).all()
    assert (read.sh[:, 1:] - scene.sh[:, 1:].clamp(-1, 127 / 128)).abs().max() < 1 / 16


def test_means_that_24_bits_cannot_hold_are_refused(make_scene, file):
    scene, _ = make_scene(dtype=torch.float32)
    write_spz(file, replace(scene, means=2.0**21 * torch.sign(scene.means)))
    assert read_spz(file).means.abs().max() == 2**21 - 0.25
    with pytest.raises(
        InputError, match=r"means reach 1\.67772e\+07: SPZ holds .* scale the scene"
    ):
        write_spz(file, replace(scene, means=2.0**24 * torch.sign(scene.means)))
    with pytest.raises(InputError, match="version is 5: choose 2, 3 or 4"):
        write_spz(file, scene, 5)


@pytest.mark.parametrize("version", VERSIONS)
def test_splat_transform_reads_the_same_numbers(make_scene, tmp_path, version):
    scene, _ = make_scene(count=300, degree=3, dtype=torch.float32)
    write_spz(tmp_path / "scene.spz", scene, version)
    theirs = read_ply(splat_transform(tmp_path / "scene.spz", tmp_path / "theirs.ply"))
    ours = read_spz(tmp_path / "scene.spz")
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(
            getattr(ours, name), getattr(theirs, name), rtol=1e-5, atol=2e-6, msg=name
        )
    # It derives the fourth component in float32, of which a small one has few digits.
    torch.testing.assert_close(rotations(ours.quats), rotations(theirs.quats), rtol=0, atol=5e-5)


@pytest.mark.parametrize("version", (3, 4))
def test_what_splat_transform_writes_is_read(make_scene, tmp_path, version):
    scene, _ = make_scene(count=300, degree=2, dtype=torch.float32)
    write_ply(tmp_path / "scene.ply", scene)
    options = ("--spz-version", str(version))
    theirs = splat_transform(tmp_path / "scene.ply", tmp_path / "theirs.spz", *options)
    read = read_spz(theirs)
    assert (read.means - scene.means).abs().max() < 1e-3
    assert (read.scales / scene.scales).log().abs().max() <= 1 / 32 + 1e-5
    assert (read.opacities - scene.opacities).abs().max() < 0.003
