"""Folders with a file of Gaussians for each scene: names, cameras beside them, what is refused."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from asysplat.data import ProceduralScene, SceneOptions, open_scene
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.evaluation.metrics import psnr
from asysplat.export import write_gaussians
from asysplat.export.scene_folder import SceneFile, check_visible, find_files
from asysplat.geometry.motion import transform
from asysplat.rendering import render
from asysplat.scene import Gaussians

SCALE = 0.3  # of the other system's units
AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's from OpenCV's


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A scene on disk, of 12 images."""
    folder = tmp_path_factory.mktemp("data") / "room"
    write_transforms(ProceduralScene(3, 24, 32, num_images=12).views(range(12)), folder)
    return open_scene(folder, SceneOptions(24, 32))


@pytest.fixture(scope="module")
def world(sequence) -> Gaussians:
    """A Gaussian in front of every camera, in the data's world."""
    poses = sequence.cameras.cam_to_world
    count = len(poses)
    return Gaussians(
        means=poses[:, :3, 3] + poses[:, :3, 2],
        quats=torch.randn(count, 4, generator=torch.Generator().manual_seed(0)),
        scales=torch.tensor([0.3, 0.2, 0.1]).repeat(count, 1),
        opacities=torch.full((count,), 0.9),
        sh=torch.randn(count, 4, 3, generator=torch.Generator().manual_seed(1)),
    )


@pytest.fixture(scope="module")
def other() -> torch.Tensor:
    """The motion to another system's world, far from the origin."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = torch.tensor(Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix())
    motion[:3, 3] = torch.tensor([5.0, -30.0, 2.0])
    return motion


@pytest.fixture
def file(tmp_path, sequence, world, other) -> SceneFile:
    """The Gaussians in the other system's world."""
    path = tmp_path / "room.v2.ply"
    write_gaussians(path, transform(world, other).scale_by(SCALE))
    return SceneFile(path, sequence)


def other_poses(sequence, other) -> list[tuple[str, np.ndarray]]:
    """The cameras in the other system's world, under names of its own folder and format."""
    poses = other.numpy() @ sequence.cameras.cam_to_world.double().numpy()
    poses[:, :3, 3] *= SCALE
    return [(f"frames/{index:05d}.jpg", pose) for index, pose in enumerate(poses)]


def write_json(file: SceneFile, poses) -> None:
    frames = [{"file_path": n, "transform_matrix": (pose @ AXES).tolist()} for n, pose in poses]
    file.path.with_name("room.v2.cameras.json").write_text(json.dumps({"frames": frames}))


def write_colmap(file: SceneFile, poses) -> None:
    model = file.path.with_name("room.v2") / "sparse/0"
    model.mkdir(parents=True)
    lines = []
    for index, (name, pose) in enumerate(poses, 1):
        inverse = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        lines += [" ".join(map(str, (index, w, x, y, z, *inverse[:3, 3], 1, name))), ""]
    (model / "cameras.txt").write_text("1 PINHOLE 32 24 30 30 16 12\n")
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("")


@pytest.mark.parametrize("write", [write_json, write_colmap])
@pytest.mark.parametrize("images", [range(12), range(3, 5)], ids=["all", "two"])
def test_cameras_bring_gaussians_to_the_datas_world(file, sequence, world, other, write, images):
    poses = other_poses(sequence, other)
    write(file, [*(poses[index] for index in images), ("of/another.png", np.eye(4))])
    found, residual = file.read()
    assert 0 <= residual < 1e-5
    for name in ("means", "scales", "sh"):
        expected = getattr(world, name).double()
        torch.testing.assert_close(getattr(found, name), expected, atol=1e-4, rtol=1e-4)
    turns = [torch.nn.functional.normalize(each.quats.double(), dim=-1) for each in (found, world)]
    torch.testing.assert_close((turns[0] * turns[1]).sum(-1).abs(), torch.ones(12).double())
    check_visible(found.to(torch.float32), sequence.cameras, file, fitted=True)


def write_long_lrm(folder, gaussians, motion) -> None:
    """Gaussians of the data's coordinates as Long-LRM writes them, normalized, in float32."""
    folder.mkdir(parents=True)
    write_gaussians(folder / "gaussians_001.ply", transform(gaussians, motion).scale_by(SCALE))
    np.savetxt(folder / "pos_avg_inv.txt", motion.float().numpy())
    np.savetxt(folder / "scene_scale.txt", np.array([SCALE]))
    np.savetxt(folder / "input_frame_idx.txt", np.arange(6), fmt="%i")


def test_long_lrms_gaussians_are_brought_to_the_datas_coordinates(sequence, world, other, tmp_path):
    write_long_lrm(tmp_path / "room", world, other)
    file = find_files(tmp_path, [sequence])["room"]
    found, residual = file.read()
    assert residual is None
    options = {"cameras": sequence.cameras, "depth": False}
    images = [render(scene, **options).image for scene in (world, found.to(torch.float32))]
    target = images[0].clamp(0, 1) * 0.9
    assert psnr(images[1], images[0]).min() > 80
    torch.testing.assert_close(psnr(images[1], target), psnr(images[0], target), atol=1e-3, rtol=0)
    check_visible(found.to(torch.float32), sequence.cameras, file, fitted=False)
    (tmp_path / "room" / "pos_avg_inv.txt").unlink()
    normalized, _ = file.read()
    assert psnr(render(normalized.to(torch.float32), **options).image, images[0]).max() < 40


def test_long_lrms_gaussians_of_a_scene_far_from_the_origin(world, other, tmp_path):
    origin = torch.tensor([4.0e5, -2.0e5, 300.0], dtype=torch.float64)
    scene = ProceduralScene(3, 8, 8, num_images=4)
    write_transforms(scene.views(range(4)), tmp_path / "room")
    content = json.loads((tmp_path / "room" / "transforms.json").read_text())
    for frame in content["frames"]:
        for axis in range(3):
            frame["transform_matrix"][axis][3] += origin[axis].item()
    (tmp_path / "room" / "transforms.json").write_text(json.dumps(content))
    sequence = open_scene(tmp_path / "room", SceneOptions(8, 8))
    moved = replace(world.to(torch.float64), means=world.means.double() + origin)
    motion = other.clone()
    motion[:3, 3] -= motion[:3, :3] @ origin
    folder = tmp_path / "long_lrm" / "room"
    write_long_lrm(folder, moved, motion)
    np.savetxt(folder / "pos_avg_inv.txt", motion.numpy())
    found, _ = find_files(tmp_path / "long_lrm", [sequence])["room"].read()
    expected = moved.means - torch.tensor(sequence.scene.origin)
    torch.testing.assert_close(found.means, expected, atol=1e-4, rtol=0)


def test_noisy_cameras_beside_a_scene_have_a_residual(file, sequence, other):
    noise = np.random.default_rng(0)
    poses = other_poses(sequence, other)
    spread = np.std([pose[:3, 3] for _, pose in poses], axis=0)
    for _, pose in poses:
        pose[:3, 3] += 0.03 * np.sqrt((spread**2).sum() / 3) * noise.standard_normal(3)
    write_json(file, poses)
    assert 0.01 < file.read()[1] < 0.05


def test_cameras_that_do_not_fit_the_images_are_refused(file, sequence, other):
    poses = other_poses(sequence, other)
    names, matrices = zip(*poses, strict=True)
    for given, message in (
        (zip(names, matrices[::-1], strict=True), r"12 cameras differ from those of room by \d+%"),
        ([(name, pose @ AXES) for name, pose in poses], "with the axes of their format"),
        ([(f"x{name[7:]}", pose) for name, pose in poses], "has 0 of the 12 images of room"),
    ):
        write_json(file, given)
        with pytest.raises(InputError, match=message) as raised:
            file.read()
        assert "cameras.json" in str(raised.value)


@pytest.fixture(scope="module")
def sequences():
    return [ProceduralScene(seed, 8, 8, num_images=4) for seed in range(7)]


NAMES = [f"procedural-{seed}" for seed in range(7)]
PLY = [f"{name}.ply" for name in NAMES]
WRONG = [
    ([*PLY, "lego.ply"], r"lego\.ply is named as no scene of the data: .* procedural-4, \.\.\.\."),
    (PLY[2:], "has no file of 2 of the 7 scenes, procedural-0, procedural-1: add them"),
]


def test_find_files_refuses_files_that_are_not_those_of_the_scenes(sequences, tmp_path):
    with pytest.raises(InputError, match=r"gaussians=.* is not a file and no folder"):
        find_files(tmp_path / "absent", sequences)
    for number, (files, message) in enumerate(WRONG):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name in files:
            (folder / name).touch()
        with pytest.raises(InputError, match=message):
            find_files(folder, sequences)


def test_find_files_gives_every_scene_its_file(sequences, tmp_path):
    for name in NAMES:
        (tmp_path / f"{name}.PLY").touch()
        (tmp_path / f"{name}.cameras.json").touch()
    (tmp_path / "procedural-0").mkdir()
    found = find_files(tmp_path, sequences)
    assert {name: file.path.name for name, file in found.items()} == {n: f"{n}.PLY" for n in NAMES}
    assert all(file.sequence.name == name for name, file in found.items())
    only = tmp_path / f"{NAMES[1]}.PLY"
    assert find_files(only, sequences[:1])[NAMES[0]].path == only
    with pytest.raises(InputError, match=re.escape("is one scene, and the data has 7 to test")):
        find_files(only, sequences)
