import json
import math
import shutil

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from asysplat.data import SceneOptions
from asysplat.data import open_scene as open_at
from asysplat.data.readers.transforms import read_cameras
from asysplat.errors import InputError

WIDTH, HEIGHT = 24, 16
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def pose(index: int) -> np.ndarray:
    """Camera-to-world, OpenGL axes."""
    angle = 0.1 * index
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array([0.3, angle, -0.2]))[0]
    matrix[:3, 3] = (index, 0.5, -2)
    return matrix


def open_scene(folder, height=HEIGHT, width=WIDTH):
    return open_at(folder, SceneOptions(height, width))


@pytest.fixture
def scene(tmp_path):
    """Write four noise images and a transforms.json after `change(content)`; return the folder."""
    content = {
        **{"w": WIDTH, "h": HEIGHT, "fl_x": 20.0, "fl_y": 21.0, "cx": 12.5, "cy": 7.5},
        "frames": [
            {"file_path": f"images/{i}.png", "transform_matrix": pose(i).tolist()} for i in range(4)
        ],
    }
    (tmp_path / "images").mkdir()
    for i in range(4):
        noise = np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / f"images/{i}.png")

    def write(change=lambda content: None):
        change(content)
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return tmp_path

    return write


def test_transforms_may_have_another_name(scene):
    folder = scene()
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    sequence = open_scene(folder / "transforms_train.json")
    assert sequence.num_images == 4 and sequence.name == folder.name


def test_field_of_view_alone_is_enough(scene):
    def change(content):
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            del content[key]
        content["camera_angle_x"] = 1.0

    intrinsics = open_scene(scene(change)).cameras.intrinsics[0]
    focal = WIDTH / 2 / math.tan(0.5)
    expected = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    torch.testing.assert_close(intrinsics, expected)


def test_intrinsics_may_be_a_matrix(scene):
    matrix = [[30.0, 0, 11.5], [0, 31.0, 8.5], [0, 0, 1]]

    def change(content):
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del content[key]
        content["K"] = [[20.0, 0, 12.5], [0, 21.0, 7.5], [0, 0, 1]]
        content["frames"][1]["K"] = matrix

    intrinsics = open_scene(scene(change)).cameras.intrinsics
    assert intrinsics[0].diagonal().tolist() == [20, 21, 1] and intrinsics[1].tolist() == matrix


def test_images_are_found_beside_the_file_and_saved_in_another_format(scene):
    def change(content):
        for frame in content["frames"][:2]:
            frame["file_path"] = frame["file_path"].replace("images", "/home/me/scene/images")
        content["frames"][2]["file_path"] = "photos/2.png"

    folder = scene(change)
    Image.open(folder / "images/0.png").save(folder / "images/0.jpg")
    (folder / "images/0.png").unlink()
    (folder / "images/2.png").rename(folder / "2.png")
    names = ("images/0.jpg", "images/1.png", "2.png", "images/3.png")
    files = {image.file for image in open_scene(folder).scene.images}
    assert files == {folder / name for name in names}


def test_images_that_the_file_tests_are_held_out(scene):
    def change(content):
        names = [frame["file_path"] for frame in content["frames"]]
        content["train_filenames"], content["test_filenames"] = names[:3], names[3:]

    images = open_scene(scene(change)).scene.images
    assert [image.held_out for image in images] == [False, False, False, True]


def test_intrinsics_and_size_of_an_entry_win(scene):
    def change(content):
        content["frames"][1] |= {"w": 48, "h": 32, "fl_x": 50.0, "fl_y": 52.0, "cx": 25, "cy": 15}

    folder = scene(change)
    Image.new("RGB", (48, 32), (255, 0, 0)).save(folder / "images/1.png")
    sequence = open_scene(folder)
    assert sequence.cameras.intrinsics[1].tolist() == [[25, 0, 12.5], [0, 26, 7.5], [0, 0, 1]]
    assert sequence.cameras.intrinsics[0, 0, 0] == 20
    assert sequence.views([1]).images[0, :, 8, 8].tolist() == [1, 0, 0]


@pytest.mark.parametrize(
    "names, suffix, order",
    [
        (["b10", "b2", "b1", "b9"], ".png", [2, 1, 3, 0]),
        (["door", "arch", "wall", "roof"], ".jpg", [0, 1, 2, 3]),
    ],
)
def test_images_follow_their_numbers_if_all_have_one(scene, names, suffix, order):
    def change(content):
        for frame, name in zip(content["frames"], names, strict=True):
            frame["file_path"] = f"./images/{name}"

    folder = scene(change)
    for i, name in enumerate(names):
        (folder / f"images/{i}.png").rename(folder / f"images/{name}{suffix}")
    assert open_scene(folder).cameras.centers[:, 0].tolist() == order


def test_depths_are_scaled_by_their_unit_and_masks_are_read(scene):
    def change(content):
        content["frames"][0] |= {"depth_file_path": "depth.png", "mask_path": "mask.png"}

    folder = scene(change)
    stored = np.arange(6 * 4, dtype=np.uint16).reshape(4, 6) * 1000
    cv2.imwrite(str(folder / "depth.png"), stored)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[4:, :5] = 1
    Image.fromarray(mask).save(folder / "mask.png")
    views = open_scene(folder).views([0, 1]).validate()
    enlarged = torch.from_numpy(stored.astype(np.float32)).kron(torch.ones(4, 4)) * 0.001
    torch.testing.assert_close(views.depths[0], enlarged)
    assert views.depths[1].max() == 0
    unit = open_scene(scene(set_scene(depth_unit_scale_factor=0.5))).views([0]).depths
    torch.testing.assert_close(unit, views.depths[:1] * 500)
    assert np.array_equal(views.masks[0], mask > 0) and bool(views.masks[1].all())


def test_rotations_are_made_orthonormal(scene):
    def change(content):
        for frame in content["frames"]:
            frame["transform_matrix"][0][0] += 4e-4

    rotation = open_scene(scene(change)).cameras.cam_to_world[:, :3, :3].double()
    residual = rotation @ rotation.mT - torch.eye(3, dtype=torch.float64)
    assert residual.abs().max() < 1e-6


def set_frame(**values):
    return lambda content: content["frames"][2].update(values)


def set_scene(**values):
    return lambda content: content.update(values)


def drop(*keys):
    return lambda content: [content.pop(key) for key in keys]


@pytest.mark.parametrize(
    "fields, model",
    [
        ({"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": 0.004}, "OPENCV"),
        ({"k1": 0.1, "k2": 0, "p1": 0, "p2": 0, "k3": 0.01}, "FULL_OPENCV"),
        ({"k1": 0, "k2": 0, "p1": 0, "p2": 0, "k3": 0, "k4": 0.3, "k5": 0.2}, "FULL_OPENCV"),
        ({"k1": 0.1, "k2": -0.02, "k3": 0.03, "k4": 0.04}, "OPENCV_FISHEYE"),
        (
            {"k1": 0.1, "k2": 0, "p1": 0, "p2": 0, "k3": 0, "k4": 0.3, "sx1": 0.2, "sy1": 0.1},
            "THIN_PRISM_FISHEYE",
        ),
    ],
)
def test_distortions_have_colmap_s_names(scene, fields, model):
    named = "OPENCV" if model == "FULL_OPENCV" and "k4" not in fields else model
    lens = open_scene(scene(set_scene(camera_model=named, **fields))).scene.images[0].lens
    camera = lens.camera()
    names = camera.params_info.split(", ")
    given = dict(zip(names, camera.params.tolist(), strict=True))
    assert camera.model_name == model and (lens.width, lens.height) == (WIDTH, HEIGHT)
    assert given == dict.fromkeys(names, 0) | {"fx": 20, "fy": 21, "cx": 12.5, "cy": 7.5} | fields


BROKEN = {
    "no frames": (drop("frames"), r'transforms\.json has no list "frames"'),
    "one frame": (lambda content: content["frames"].__delitem__(slice(1, None)), "has 1 usable"),
    "nan": (set_frame(transform_matrix=(pose(0) * np.nan).tolist()), r"frame 2 .*NaN"),
    "transposed": (set_frame(transform_matrix=pose(1).T.tolist()), r"frame 2 .*last row"),
    "mirrored": (
        set_frame(transform_matrix=(np.diag([-1.0, 1, 1, 1]) @ pose(0)).tolist()),
        r"frame 2 .*determinant is -1",
    ),
    "no intrinsics": (drop("fl_x", "fl_y"), r"has no intrinsics: give fl_x"),
    "camera model": (
        set_scene(camera_model="ORTHOPHOTO"),
        r"camera_model is 'ORTHOPHOTO': undistort",
    ),
    "other resolution": (set_scene(w=48, h=32), r"48 x 32, but the image is 24 x 16"),
}


@pytest.mark.parametrize("change, message", BROKEN.values(), ids=BROKEN.keys())
def test_broken_transforms_are_refused(scene, change, message):
    with pytest.raises(InputError, match=message):
        open_scene(scene(change))


def test_photographs_that_are_stored_turned_are_named_once(scene):
    with pytest.raises(InputError) as error:
        open_scene(scene(set_scene(w=HEIGHT, h=WIDTH)))
    tag = "with an orientation tag, and their intrinsics are for 16 x 24"
    assert f"stored as 24 x 16, {tag}" in str(error.value)
    assert str(error.value).count(tag) == 1


def test_missing_transforms_and_images_of_two_sizes_are_refused(scene):
    folder = scene()
    Image.new("RGB", (30, 16)).save(folder / "images/2.png")
    with pytest.raises(InputError, match=r"0\.png is 24 x 16 and .*2\.png is 30 x 16"):
        open_scene(folder)
    (folder / "transforms.json").write_text("{")
    with pytest.raises(InputError, match=r"transforms\.json.*is not JSON"):
        open_scene(folder)
    (folder / "transforms.json").unlink()
    shutil.rmtree(folder / "images")
    with pytest.raises(InputError, match="holds no photographs"):
        open_scene(folder)


def test_cameras_are_read_without_their_images(scene):
    folder = scene(lambda content: content["frames"][2].update(w=48, h=32, fl_x=44.0))
    shutil.rmtree(folder / "images")
    cameras = read_cameras(folder / "transforms.json")
    assert (cameras.height, cameras.width, cameras.num_views) == (HEIGHT, WIDTH, 4)
    assert cameras.intrinsics[0].tolist() == [[20, 0, 12.5], [0, 21, 7.5], [0, 0, 1]]
    assert cameras.intrinsics[2].tolist() == [[22, 0, 6.25], [0, 10.5, 3.75], [0, 0, 1]]
    poses = np.stack([pose(i) @ FLIP for i in range(4)])
    np.testing.assert_allclose(cameras.cam_to_world, poses, atol=1e-6)
