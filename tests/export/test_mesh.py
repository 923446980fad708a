"""Meshes of exact depths against the true surfaces, and their files."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from asysplat import write_gaussians
from asysplat.data import ProceduralScene
from asysplat.data.write import describe_cameras
from asysplat.errors import InputError
from asysplat.export import fusion
from asysplat.export import mesh as meshes
from asysplat.export.__main__ import export
from asysplat.export.formats.glb import to_linear
from asysplat.export.formats.packing import half_turn
from asysplat.export.fusion import fuse
from asysplat.export.gaussians import CAMERAS
from asysplat.export.mesh import MESHES, mesh_suffix, write_mesh
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.reconstruct.results import read_outputs
from asysplat.scene import Cameras, Gaussians

DISTANCE = 3.0  # of the cameras from the center of a unit sphere
ORANGE = torch.tensor([0.9, 0.5, 0.1])


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


def surface_points(views):
    local = views.cameras.pixel_directions() * views.depths[..., None]
    rotations = views.cameras.cam_to_world[:, None, :3, :3]
    return (local @ rotations.mT + views.cameras.centers[:, None, None]).flatten(0, 2)


def test_a_room_is_accurate_and_complete():
    scene = ProceduralScene(3, 64, 64, places="rooms")
    fused, held_out = scene.views(range(0, 96, 8)), scene.views(range(4, 96, 8))
    mesh = as_trimesh(fuse(fused.depths, fused.images, fused.cameras))
    true, held_out = (
        torch.cat([surface_points(v) for v in (fused, held_out)]),
        surface_points(held_out),
    )
    close = 0.01 * (true.amax(0) - true.amin(0)).max().item()
    distances, _ = cKDTree(true).query(mesh.sample(20_000, seed=0))
    assert (distances < close).mean() > 0.9
    distances, _ = cKDTree(mesh.sample(100_000, seed=0)).query(held_out)
    assert (distances < close).mean() > 0.8


def sphere(rotations, side=64):
    """Depths of the unit sphere from cameras that look at its center, and nothing behind it."""
    poses = torch.eye(4).repeat(len(rotations), 1, 1)
    poses[:, :3, :3] = torch.tensor(rotations)
    poses[:, :3, 3] = -DISTANCE * poses[:, :3, 2]
    intrinsics = torch.tensor([[1.3 * side, 0, side / 2], [0, 1.3 * side, side / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics.repeat(len(poses), 1, 1), poses, side, side)
    directions = cameras.pixel_directions()
    squares = directions.square().sum(-1)
    root = DISTANCE**2 - squares * (DISTANCE**2 - 1)
    depths = torch.where(root > 0, (DISTANCE - root.clamp_min(0).sqrt()) / squares, torch.inf)
    return depths, ORANGE[:, None, None].expand(len(poses), 3, side, side), cameras


def test_a_sphere_is_closed_and_faces_outward():
    mesh = fuse(*sphere(Rotation.random(32, rng=0).as_matrix()), voxel=0.05)
    radii = mesh.vertices.norm(dim=1)
    assert (radii - 1).abs().max() < 0.05
    shape = as_trimesh(mesh)
    assert shape.is_watertight and shape.body_count == 1
    assert shape.volume == pytest.approx(4 / 3 * np.pi, rel=0.02)
    outward = (shape.face_normals * shape.triangles_center).sum(1)
    assert (outward > 0).mean() > 0.99
    torch.testing.assert_close(mesh.colors, ORANGE.expand_as(mesh.colors))


def test_what_is_not_seen_or_masked_out_has_no_surface():
    depths, images, cameras = sphere(np.eye(3)[None])
    depths = depths.where(depths.isfinite(), 0)
    mesh = fuse(depths, images, cameras, voxel=0.05)
    horizon = -1 / DISTANCE  # greatest z that the camera sees
    assert mesh.vertices[:, 2].min() < -0.95 and mesh.vertices[:, 2].max() < horizon + 0.05
    masked = depths.clone()
    masked[..., 32:] = 0
    mesh = fuse(masked, images, cameras, voxel=0.05)
    assert mesh.vertices[:, 0].min() < -0.8 and mesh.vertices[:, 0].max() < 0.05
    assert len(fuse(torch.zeros_like(depths), images, cameras).faces) == 0


def test_a_view_through_a_floater_removes_it():
    depths, images, cameras = sphere(Rotation.random(32, rng=0).as_matrix())
    floating = depths.clone()
    floating[0, 30:34, 30:34] = 1.0
    shape = as_trimesh(fuse(floating, images, cameras, voxel=0.05))
    assert np.linalg.norm(shape.vertices, axis=1).max() < 1.1


def test_far_origins_and_many_blocks_change_nothing(monkeypatch):
    depths, images, cameras = sphere(Rotation.random(8, rng=0).as_matrix())
    near = fuse(depths, images, cameras, voxel=0.05)
    poses = cameras.cam_to_world.double()
    poses[:, :3, 3] += 1000
    far = fuse(depths, images, replace(cameras, cam_to_world=poses), voxel=0.05)
    assert (far.vertices - 1000).norm(dim=1).mean() == pytest.approx(1, abs=0.01)
    assert len(far.faces) == pytest.approx(len(near.faces), rel=0.02)
    monkeypatch.setattr(fusion, "MAX_BLOCKS", 100)
    coarse = fuse(depths, images, cameras, voxel=0.01)
    assert (coarse.vertices.norm(dim=1) - 1).abs().max() < 0.2
    assert 0 < len(coarse.faces) < len(near.faces)


def points_at(means):
    count = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[0.04, 0.04, 0.004]]).repeat(count, 1),
        opacities=torch.where(means[:, 0] < 0, 0.95, 0.02),
        sh=((ORANGE - 0.5) / SH_C0).expand(count, 1, 3),
    )


@pytest.fixture
def wall():
    """Gaussians in a plane, opaque on one side and faint on the other, and cameras before it."""
    x, y = torch.meshgrid(*[torch.linspace(-1, 1, 41)] * 2, indexing="ij")
    means = torch.stack((x, y, 0.1 * x), -1).flatten(0, 1)
    cameras = sphere(Rotation.from_euler("yx", [[0, 0], [0.3, 0], [-0.3, 0.2]]).as_matrix())[2]
    return points_at(means), cameras


@pytest.mark.parametrize("suffix", MESHES)
def test_a_file_has_the_opaque_surfaces_and_their_colors(wall, tmp_path, suffix):
    mesh = write_mesh(tmp_path / f"scene{suffix}", *wall)
    x, y, z = mesh.vertices.unbind(-1)
    assert -1.2 < x.min() < -0.9 and -0.1 < x.max() < 0.2
    inner = (x > -0.8) & (x < -0.2) & (y.abs() < 0.8)  # without the rim, whose back is not seen
    assert inner.sum() > 100 and (z - 0.1 * x)[inner].abs().max() < 0.05
    assert (mesh.colors - ORANGE)[inner].abs().max() < 0.02
    vertices, colors = mesh.vertices, mesh.colors
    if suffix == ".mesh.glb":
        # As Gaussians in glTF: left, up, forward.
        vertices, colors = half_turn(points_at(vertices), 2).means, to_linear(colors)
    # With the material, trimesh would leave out the colors.
    options = {} if suffix == ".mesh.ply" else {"skip_materials": True}
    read = trimesh.load_mesh(tmp_path / f"scene{suffix}", process=False, **options)
    np.testing.assert_allclose(read.vertices, vertices, atol=1e-6)
    assert np.array_equal(read.faces, mesh.faces)
    np.testing.assert_allclose(read.visual.vertex_colors[:, :3], 255 * colors, atol=0.51)


def test_a_scene_is_exported_as_a_mesh(wall, tmp_path, capsys):
    gaussians, cameras = wall
    file = tmp_path / "scene.ply"
    write_gaussians(file, gaussians)
    with pytest.raises(InputError, match=r"scene\.ply has no transforms\.json.*mesh\.glb needs"):
        export(file, tmp_path / "mesh.glb")
    content = describe_cameras(cameras, [f"{view}.png" for view in range(3)])
    (tmp_path / CAMERAS).write_text(json.dumps(content))
    for name in ("mesh.glb", "small.mesh.ply"):
        export(file, tmp_path / name)
        triangles = len(trimesh.load(tmp_path / name, force="mesh", process=False).faces)
        assert f"{name}: {triangles:,} triangles" in capsys.readouterr().out
    faint = replace(gaussians, opacities=gaussians.opacities / 100)
    with pytest.raises(
        InputError, match=r"mesh\.ply is not written: in 3 views no alpha is above 1/2"
    ):
        write_mesh(tmp_path / "mesh.ply", faint, cameras)
    assert not (tmp_path / "mesh.ply").exists()


def test_names_of_meshes():
    names = ("mesh.ply", "a/scene.Mesh.GLB", "mymesh.ply", "mesh.obj")
    assert [mesh_suffix(name) for name in names] == [".mesh.ply", ".mesh.glb", None, None]
    assert read_outputs(["ply", "mesh.glb"]) == [".ply", ".mesh.glb"]


def test_missing_packages_are_said_before_the_work(monkeypatch, tmp_path):
    monkeypatch.setattr(meshes, "find_spec", lambda name: None)
    message = r"needs scikit-image and trimesh: pip install 'asysplat\[mesh\]'\.$"
    with pytest.raises(InputError, match=f"^output=mesh.glb {message}"):
        read_outputs(["ply", "mesh.glb"])
    with pytest.raises(InputError, match=message):
        export(tmp_path / "missing.ply", tmp_path / "mesh.glb")
