"""Equirectangular photographs, whose color is a known function of the direction in the world."""

import json
from dataclasses import replace

import numpy as np
import pytest
from layouts import AXES
from PIL import Image
from scipy.spatial.transform import Rotation

from asysplat.data import SceneOptions, open_scene
from asysplat.data.bad_images import BadImages
from asysplat.data.cameras import CameraOptions, refine_given
from asysplat.data.check.report import check_scene
from asysplat.data.images import PANORAMA, undistort
from asysplat.data.readers.additions import YAWS, panorama
from asysplat.data.sequence import PosedScene
from asysplat.errors import InputError

WIDTH, HEIGHT = 256, 128
NAMES = [f"{index}.png" for index in range(3)]
WAVES = np.array([[3.0, 1, -2], [-2, 3, 1], [1, -2, 3]])


def color(directions):
    """Smooth colors in [0, 1] of unit directions in the world, [..., 3]."""
    return 0.5 + 0.4 * np.sin(directions @ WAVES)


def kept(directions):
    return directions @ (0.6, 0.0, 0.8) < 0.5


def poses():
    """Camera-to-world with OpenCV axes, turned in all ways."""
    result = np.tile(np.eye(4), (len(NAMES), 1, 1))
    angles = [[20, 5, 9], [130, -8, 4], [250, 3, -6]]
    result[:, :3, :3] = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    result[:, :3, 3] = [[0, 0, 0], [1, 0, 0.2], [2, 0.1, 0]]
    return result


def directions_of(pose, width=WIDTH, height=HEIGHT):
    """Directions in the world of a panorama's pixels: forward in its middle, right is right."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5)[:, None] * np.pi
    x, z = np.sin(longitude) * np.cos(latitude), np.cos(longitude) * np.cos(latitude)
    y = np.sin(latitude) + 0 * longitude
    return np.stack((x, y, z), -1) @ pose[:3, :3].T


def write_colmap(folder):
    images = []
    for index, (name, pose) in enumerate(zip(NAMES, np.linalg.inv(poses()), strict=True)):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        images.append(" ".join(map(str, (index + 1, w, x, y, z, *pose[:3, 3], 1, name))) + "\n\n")
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 {PANORAMA} {WIDTH} {HEIGHT} {WIDTH} {HEIGHT}\n")
    (model / "images.txt").write_text("".join(images))
    (model / "points3D.txt").write_text("")


def write_transforms(folder, height=HEIGHT):
    entries = [
        {"file_path": f"images/{name}", "transform_matrix": (pose @ AXES).tolist()}
        for name, pose in zip(NAMES, poses(), strict=True)
    ]
    content = {"camera_model": PANORAMA, "w": WIDTH, "h": height, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(content))


def save_images(folder, size=(WIDTH, HEIGHT)):
    (folder / "images").mkdir()
    for name, pose in zip(NAMES, poses(), strict=True):
        levels = np.round(255 * color(directions_of(pose, *size))).astype(np.uint8)
        Image.fromarray(levels).save(folder / "images" / name)


def save_mask(folder, index, **size):
    (folder / "masks").mkdir()
    mask = kept(directions_of(poses()[index], **size))
    Image.fromarray(mask).save(folder / "masks" / NAMES[index])


@pytest.fixture(params=[write_colmap, write_transforms])
def scene(request, tmp_path):
    save_images(tmp_path)
    request.param(tmp_path)
    return tmp_path


def opened(folder, side=64, **options):
    return open_scene(folder, SceneOptions(side, side, **options))


def rays(sequence):
    """Unit directions in the world of the views' pixels, [V, H, W, 3]."""
    directions = sequence.cameras.pixel_directions().double()
    directions = directions / directions.norm(dim=-1, keepdim=True)
    rotations = sequence.cameras.cam_to_world[:, None, :3, :3].double()
    return (directions @ rotations.mT).numpy()


def test_faces_show_what_lies_in_their_directions(scene):
    sequence = opened(scene)
    images = sequence.views(range(sequence.num_images)).images.permute(0, 2, 3, 1).numpy()
    assert images.shape == (4 * len(NAMES), 64, 64, 3)
    assert np.abs(images - color(rays(sequence))).max() < 0.01


def test_faces_of_a_side_follow_each_other_and_meet_at_their_edges(scene):
    sequence = opened(scene)
    images = sequence.scene.images
    assert [image.file.name for image in images] == len(YAWS) * NAMES
    assert [image.lens.yaw for image in images] == np.repeat(YAWS, len(NAMES)).tolist()
    forward = sequence.cameras.cam_to_world[:: len(NAMES), :3, 2].numpy()
    right = sequence.cameras.cam_to_world[:: len(NAMES), :3, 0].numpy()
    np.testing.assert_allclose(np.roll(forward, -1, axis=0), right, atol=1e-6)
    lens = images[0].lens
    assert lens.width == lens.height == 82 and 90 <= 2 * np.degrees(np.arctan(41 / lens.fx)) < 91


def test_panoramas_may_be_smaller_than_their_camera_s(tmp_path):
    save_images(tmp_path, size=(WIDTH // 2, HEIGHT // 2))
    write_colmap(tmp_path)
    sequence = opened(tmp_path, side=32)
    assert sequence.scene.images[0].lens.width == 41
    images = sequence.views(range(12)).images.permute(0, 2, 3, 1).numpy()
    assert np.abs(images - color(rays(sequence))).max() < 0.02


@pytest.mark.parametrize("nearest", [False, True])
def test_a_panorama_has_no_seam(nearest):
    """What is seen is the same wherever the panorama's first column lies."""
    pixels = np.random.default_rng(0).random((HEIGHT, WIDTH), np.float32)
    # With an odd side, the middle of the face behind lies on the border.
    square = {"width": 83, "height": 83, "cx": 41.5, "cy": 41.5}
    front = replace(panorama(WIDTH, HEIGHT, "panorama"), **square)
    back = replace(front, yaw=180.0)
    found = undistort(pixels, back, nearest)
    expected = undistort(np.roll(pixels, WIDTH // 2, axis=1), front, nearest)
    # Positions between pixels are rounded to 1/32, and to pixels with `nearest`.
    assert (np.abs(found - expected) > 1 / 16).mean() < 1e-3
    assert undistort(np.ones((HEIGHT, WIDTH), bool), back).all()


def test_a_mask_beside_a_panorama_is_every_face_s(scene):
    save_mask(scene, 1, width=WIDTH // 2, height=HEIGHT // 2)
    sequence = opened(scene)
    masks = sequence.views(range(12)).masks.numpy()
    expected = kept(rays(sequence))
    assert 0.2 < expected[1::3].mean() < 0.9 and masks[0::3].all() and masks[2::3].all()
    # A new pixel is kept where all are that it covers.
    assert (masks[1::3] != expected[1::3]).mean() < 0.03


def test_the_check_does_not_take_faces_for_copies(scene):
    rows = check_scene(opened(scene).scene, BadImages()).rows
    assert not any("same file" in text for _, text in rows)
    (lens,) = (text for name, text in rows if name == "lens")
    assert lens.startswith(f"12 of 82 x 82 {PANORAMA}: fx 40.744")


def test_cameras_of_panoramas_stay_as_given(scene):
    said, posed = [], opened(scene).scene
    one = PosedScene("faces of three panoramas", posed.images[:3])
    assert refine_given(one, CameraOptions("refined"), said.append) == (one, False)
    assert "cameras: as given; panoramas" in said[0]


def test_panoramas_that_cannot_be_used_are_named(tmp_path):
    save_images(tmp_path)
    write_transforms(tmp_path, height=WIDTH)
    with pytest.raises(InputError, match="w x h is 256 x 256, but the image is 256 x 128"):
        opened(tmp_path)
