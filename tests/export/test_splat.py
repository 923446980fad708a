import numpy as np
import torch
from oracles import splat_transform

from asysplat.export import read_ply, read_splat
from asysplat.export.formats.splat import write_splat
from asysplat.geometry.motion import rotations
from asysplat.geometry.spherical_harmonics import SH_C0, sh_colors


def row(mean=(1, 2, 3), scale=(0.1, 0.2, 0.3), rgba=(255, 51, 0, 204), quat=(128, 0, 192, 128)):
    return np.array([*mean, *scale], "<f4").tobytes() + bytes(rgba) + bytes(quat)


def test_read_splat_reads_every_field(tmp_path):
    file = tmp_path / "two.splat"
    file.write_bytes(row() + row(mean=(4, 5, 6), scale=(0, 1, 1), rgba=(0, 0, 0, 0)))
    read = read_splat(file)
    assert read.means.tolist() == [[1, 2, 3], [4, 5, 6]]
    torch.testing.assert_close(read.scales[0], torch.tensor([0.1, 0.2, 0.3]))
    assert read.quats[0].tolist() == [0, -1, 0.5, 0]
    colors = sh_colors(read.sh, torch.randn(2, 3))
    torch.testing.assert_close(colors[0], torch.tensor([1, 0.2, 0]))
    torch.testing.assert_close(read.opacities[0], torch.tensor(0.8))
    # What is stored as 0 is kept, as good as invisible.
    assert 0 < read.opacities[1] < 1e-30 and 0 < read.scales[1, 0] < 1e-30


def test_read_splat_of_a_real_plant_gives_the_numbers_of_its_readme(shared):
    plant = read_splat(shared / "data" / "splats" / "plant.splat")
    assert plant.num_gaussians == 113_648
    center = torch.tensor([0.02, 0.01, 0.02])
    assert (plant.means.mean(0) - center).abs().max() < 0.02
    assert ((plant.means - center).norm(dim=-1) < 0.39).float().mean() > 0.88


def test_a_scene_comes_back_the_most_visible_first(make_scene, tmp_path):
    scene, _ = make_scene(count=300, degree=2, dtype=torch.float32)
    scene = scene.map(lambda field: field[(scene.opacities * scene.scales.prod(1)).argsort()])
    write_splat(tmp_path / "scene.splat", scene)
    read = read_splat(tmp_path / "scene.splat").map(lambda field: field.flip(0))
    assert torch.equal(read.means, scene.means) and torch.equal(read.scales, scene.scales)
    assert (read.opacities - scene.opacities).abs().max() <= 0.5 / 255 + 1e-6
    colors, stored = (0.5 + SH_C0 * sh[:, 0] for sh in (scene.sh, read.sh))
    assert (stored - colors.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6
    torch.testing.assert_close(rotations(read.quats), rotations(scene.quats), rtol=0, atol=0.02)


def test_splat_transform_reads_the_same_numbers(make_scene, tmp_path):
    scene, _ = make_scene(count=300, degree=0, dtype=torch.float32)
    write_splat(tmp_path / "scene.splat", scene)
    ours = read_splat(tmp_path / "scene.splat")
    theirs = read_ply(splat_transform(tmp_path / "scene.splat", tmp_path / "theirs.ply"))
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(
            getattr(theirs, name), getattr(ours, name), rtol=1e-5, atol=2e-6, msg=name
        )
    # It takes 255 for 1, the format's viewer 256: rotations differ by half of a step.
    torch.testing.assert_close(rotations(theirs.quats), rotations(ours.quats), rtol=0, atol=0.02)
