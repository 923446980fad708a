"""PlayCanvas's compressed PLY: what comes back, and what another program reads and writes."""

import pytest
import torch
from oracles import splat_transform

from asysplat.export import read_ply, write_ply
from asysplat.export.formats.compressed_ply import write_compressed_ply
from asysplat.export.formats.packing import morton_order
from asysplat.geometry.motion import rotations
from asysplat.scene import Gaussians


@pytest.fixture
def file(tmp_path):
    return tmp_path / "scene.compressed.ply"


def assert_near(read, scene):
    """Within the steps of the format: ranges of 11 and 10 bits, colors of 8, SH of 1 / 32."""
    extent = scene.means.amax(0) - scene.means.amin(0)
    assert ((read.means - scene.means).abs() <= extent / torch.tensor([2047, 1023, 2047])).all()
    logs = scene.scales.log()
    assert (read.scales.log() - logs).abs().max() <= (logs.max() - logs.min()) / 1023
    assert (read.opacities - scene.opacities).abs().max() <= 0.5 / 255 + 1e-6
    torch.testing.assert_close(read.sh[:, 1:], scene.sh[:, 1:], rtol=0, atol=1 / 64 + 1e-5)
    torch.testing.assert_close(rotations(read.quats), rotations(scene.quats), rtol=0, atol=0.004)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 256, 700])
def test_a_scene_comes_back_within_the_precision_of_the_format(make_scene, file, degree, count):
    scene, _ = make_scene(count=count, degree=degree, dtype=torch.float32)
    write_compressed_ply(file, scene)
    assert_near(read_ply(file), scene.map(lambda field: field[morton_order(scene.means)]))


def test_extremes_are_kept_or_limited(file):
    scene = Gaussians(
        means=torch.tensor([[0.0, 0, 0], [1e-3, 1e6, 0]]),
        quats=torch.eye(4)[:2],
        scales=torch.tensor([[1e-30, 1, 1], [1e30, 1, 1]]),
        opacities=torch.tensor([1e-9, 1]),
        sh=torch.tensor([-9.0, 9])[:, None, None].repeat(1, 4, 3),
    )
    write_compressed_ply(file, scene)
    read = read_ply(file)
    assert torch.equal(read.means, scene.means)
    assert read.scales.log()[:, 0].tolist() == pytest.approx([-20, 20], abs=1e-4)
    assert (read.opacities > 0).all() and read.opacities[1] == 1
    assert torch.equal(read.sh[:, 1:], scene.sh[:, 1:].clamp(-4, 4))
    torch.testing.assert_close(read.sh[:, 0], scene.sh[:, 0])


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_and_writes_the_same_numbers(make_scene, file, tmp_path, degree):
    scene, _ = make_scene(count=700, degree=degree, dtype=torch.float32)
    write_compressed_ply(file, scene)
    theirs, ours = read_ply(splat_transform(file, tmp_path / "theirs.ply")), read_ply(file)
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(
            getattr(ours, name), getattr(theirs, name), rtol=1e-5, atol=2e-6, msg=name
        )
    torch.testing.assert_close(rotations(ours.quats), rotations(theirs.quats), rtol=0, atol=1e-5)
    write_ply(tmp_path / "scene.ply", scene)
    back = read_ply(splat_transform(tmp_path / "scene.ply", tmp_path / "theirs.compressed.ply"))
    order = (back.means[:, None] - scene.means).norm(dim=-1).argmin(1)
    assert order.unique().numel() == 700
    assert_near(back, scene.map(lambda field: field[order]))
