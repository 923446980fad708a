import zipfile
from dataclasses import replace

import pytest
import torch
from oracles import splat_transform

from asysplat import render
from asysplat.errors import InputError
from asysplat.export import read_ply, write_ply
from asysplat.export.formats import sog
from asysplat.export.formats.packing import morton_order
from asysplat.export.formats.sog import read_sog, write_sog
from asysplat.geometry.motion import rotations


def check_close(read, scene):
    """Check that all fields are as close as the format's numbers are to each other."""
    order = morton_order(scene.means)
    scene = scene.map(lambda field: field[order].float())
    logs, read_logs = (g.means.sign() * g.means.abs().log1p() for g in (scene, read))
    step = (logs.amax(0) - logs.amin(0)) / 65535
    assert ((read_logs - logs).abs() <= 0.51 * step + 1e-6 * (1 + logs.abs())).all()
    product = rotations(read.quats).mT @ rotations(scene.quats)
    angles = ((product.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1).acos()
    assert angles.max() < 0.02
    torch.testing.assert_close(read.quats.norm(dim=-1), torch.ones(len(angles)))
    logs = scene.scales.log()
    assert (read.scales.log() - logs).abs().max() <= 0.006 * (logs.max() - logs.min()) + 1e-5
    assert (read.opacities - scene.opacities).abs().max() <= 0.5 / 255 + 1e-6
    assert (read.sh[:, 0] - scene.sh[:, 0]).abs().max() <= 0.006 * spread(scene.sh[:, 0]) + 1e-6
    if scene.sh.shape[1] > 1:
        rest, read_rest = scene.sh[:, 1:], read.sh[:, 1:]
        assert (read_rest - rest).abs().max() <= 0.006 * spread(rest) + 1e-6


def spread(values):
    return values.max() - values.min()


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [1, 257])
def test_a_scene_comes_back_within_the_format_s_precision(make_scene, tmp_path, degree, count):
    scene, _ = make_scene(count, degree=degree)
    write_sog(tmp_path / "scene.sog", scene)
    check_close(read_sog(tmp_path / "scene.sog"), scene)
    content = (tmp_path / "scene.sog").read_bytes()
    write_sog(tmp_path / "scene.sog", scene)
    assert (tmp_path / "scene.sog").read_bytes() == content


def test_extreme_values_come_back(make_scene, tmp_path):
    scene, _ = make_scene(300, dtype=torch.float32)
    generator = torch.Generator().manual_seed(0)
    scene = replace(
        scene,
        means=torch.cat((1e6 * scene.means[:, :2], torch.full((300, 1), 7.0)), 1),
        scales=10 ** (13 * torch.rand(300, 3, generator=generator) - 10),
        opacities=torch.linspace(1e-7, 1, 300),
        sh=scene.sh * torch.tensor([1.0, 1e-3, 1e-5, 0])[:, None],
    )
    write_sog(tmp_path / "scene.sog", scene)
    read = read_sog(tmp_path / "scene.sog")
    check_close(read, scene)
    torch.testing.assert_close(read.means[:, 2], torch.full((300,), 7.0))
    assert 0 < read.opacities.min() < 1e-30 and read.opacities.max() == 1


@pytest.mark.parametrize("degree", range(4))
def test_splat_transform_reads_the_same_numbers(make_scene, tmp_path, degree):
    scene, _ = make_scene(257, degree=degree)
    write_sog(tmp_path / "scene.sog", scene)
    splat_transform(tmp_path / "scene.sog", tmp_path / "scene.ply")
    check_same(read_sog(tmp_path / "scene.sog"), read_ply(tmp_path / "scene.ply"))


@pytest.mark.medium
@pytest.mark.parametrize("degree", range(4))
def test_files_of_splat_transform_are_read(make_scene, tmp_path, degree):
    scene, _ = make_scene(257, degree=degree)
    write_ply(tmp_path / "scene.ply", scene)
    splat_transform(tmp_path / "scene.ply", tmp_path / "scene.sog")
    splat_transform(tmp_path / "scene.sog", tmp_path / "again.ply")
    check_same(read_sog(tmp_path / "scene.sog"), read_ply(tmp_path / "again.ply"))


def check_same(read, other):
    for name in ("means", "scales", "sh"):
        torch.testing.assert_close(getattr(read, name), getattr(other, name), rtol=1e-5, atol=1e-6)
    # Its logits end at 1e-6 and 1 - 1e-6.
    torch.testing.assert_close(read.opacities, other.opacities, rtol=1e-5, atol=1e-5)
    product = rotations(read.quats).mT @ rotations(other.quats)
    torch.testing.assert_close(product, torch.eye(3).expand_as(product), rtol=0, atol=1e-4)


def test_images_hardly_change(make_scene, tmp_path):
    scene, cameras = make_scene(20_000, height=64, width=64, dtype=torch.float32)
    scene = replace(scene, scales=0.2 * scene.scales, sh=0.3 * scene.sh)
    write_sog(tmp_path / "scene.sog", scene)
    read = read_sog(tmp_path / "scene.sog")
    error = (render(read, cameras).image - render(scene, cameras).image).square().mean()
    assert -10 * error.log10() > 40
    assert (tmp_path / "scene.sog").stat().st_size < 25 * scene.num_gaussians


def test_the_palette_is_nearly_the_best(monkeypatch):
    centers = torch.randn(64, 9)
    values = centers[torch.randint(64, (5000,))] + 0.01 * torch.randn(5000, 9)
    monkeypatch.setattr(sog, "MIN_PALETTE", 256)
    monkeypatch.setattr(sog, "PALETTE_SHARE", 20)
    palette, labels = sog._palette(values)
    assert len(palette) <= 256 and labels.max() == len(palette) - 1
    assert (palette[labels] - values).square().mean().sqrt() < 0.02
    codes, indices = sog._codebook(values)
    codes = torch.tensor(codes, dtype=torch.float64)
    assert len(codes) == 256 and (codes.diff() >= 0).all()
    nearest = (codes - values.double()[..., None]).abs().amin(-1)
    torch.testing.assert_close((codes[indices] - values.double()).abs(), nearest)


def rewrite(file, edit=lambda members: None, compression=zipfile.ZIP_STORED):
    """Write a bundle again after a change of its members."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    edit(members)
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, member in members.items():
            archive.writestr(name, member)


@pytest.fixture
def written(make_scene, tmp_path):
    write_sog(tmp_path / "scene.sog", make_scene()[0])
    return tmp_path / "scene.sog"


def test_deflated_bundles_are_read(written):
    scene = read_sog(written)
    rewrite(written, compression=zipfile.ZIP_DEFLATED)
    assert torch.equal(read_sog(written).means, scene.means)


def test_other_versions_are_refused(written):
    def set_version(members):
        members["meta.json"] = members["meta.json"].replace(b'"version":2', b'"version":3')

    rewrite(written, set_version)
    with pytest.raises(InputError, match=r"scene\.sog.*it has version 3 of SOG: expected 2"):
        read_sog(written)
