import shutil
import warnings
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from layouts import colmap as layout
from layouts import save_image, table
from PIL import Image

from asysplat.data.bad_images import BadImages
from asysplat.data.images import PANORAMA, Lens
from asysplat.data.readers import colmap
from asysplat.data.readers.colmap_model import CAMERA_MODELS
from asysplat.data.sequence import FileSequence, SceneOptions
from asysplat.errors import InputError


@pytest.fixture
def scene(views, tmp_path):
    """A folder with the text model of COLMAP until 3.11."""
    return layout.write(views, tmp_path / "scene")


def read(folder):
    bad = BadImages()
    posed = colmap.read_scene(folder, bad)
    bad.report(str(folder), len(posed.images))
    return posed


def cameras_of(posed):
    return np.array([image.cam_to_world for image in posed.images])


def names_of(posed):
    return [image.file.name for image in posed.images]


def edit(file, change):
    file.write_text(change(file.read_text(encoding="utf-8")), encoding="utf-8")


def with_camera(folder, line):
    """Give every image the camera `line`: model, width, height and parameters."""
    lines = (f"{index + 1} {line}\n" for index in range(12))
    (folder / "sparse/0/cameras.txt").write_text("".join(lines))
    return folder


def as_binary(folder, old=False):
    """The same model as COLMAP writes it today, or as it did until 3.11."""
    model = folder / "sparse/0"
    pycolmap.Reconstruction(model).write_binary(model)
    for file in model.glob("*.txt"):
        file.unlink()
    if old:
        (model / "rigs.bin").unlink()
        (model / "frames.bin").unlink()
    return folder


def test_images_follow_their_numbers_and_have_the_model_s_points(scene, views):
    assert names_of(read(scene)) == [f"{index}.png" for index in range(12)]
    np.testing.assert_allclose(read(scene).points, layout.points_of(views), atol=1e-9)


@pytest.mark.parametrize("old", [True, False])
def test_text_and_binary_are_the_same(scene, old):
    text, binary = read(scene), read(as_binary(scene, old))
    assert names_of(text) == names_of(binary)
    assert [p.lens for p in text.images] == [p.lens for p in binary.images]
    np.testing.assert_allclose(cameras_of(text), cameras_of(binary), atol=1e-12)
    np.testing.assert_allclose(text.points, binary.points, atol=1e-12)


def test_the_model_is_found_in_its_usual_folders(scene, tmp_path):
    model = scene / "sparse/0"
    for place in ("sparse", "colmap/sparse/0", "."):
        folder = tmp_path / f"in {place.replace('/', ' ')}" / "scene"
        shutil.copytree(scene / "images", folder / "images")
        shutil.copytree(model, folder / place, dirs_exist_ok=True)
        assert colmap.find_scenes(folder.parent) == [folder], place
        assert len(read(folder).images) == 12, place


LENSES = [
    "SIMPLE_PINHOLE 320 240 200 162 117",
    "PINHOLE 320 240 200 210 162 117",
    "SIMPLE_RADIAL 320 240 200 162 117 0.1",
    "RADIAL 320 240 200 162 117 0.1 -0.02",
    "OPENCV 320 240 200 210 162 117 0.1 -0.02 0.003 0.004",
    "FULL_OPENCV 320 240 200 210 162 117 0.1 -0.02 0.003 0.004 0.01 0.2 0.03 -0.01",
    "SIMPLE_DIVISION 320 240 200 162 117 -0.1",
    "DIVISION 320 240 200 210 162 117 -0.1",
    "FOV 320 240 200 210 162 117 0.8",
    "EUCM 320 240 200 210 162 117 0.5 1.1",
    "SIMPLE_FISHEYE 320 240 200 162 117",
    "FISHEYE 320 240 200 210 162 117",
    "SIMPLE_RADIAL_FISHEYE 320 240 200 162 117 0.1",
    "RADIAL_FISHEYE 320 240 200 162 117 0.1 -0.02",
    "OPENCV_FISHEYE 320 240 200 210 162 117 0.1 -0.02 0.03 0.04",
    "THIN_PRISM_FISHEYE 320 240 200 210 162 117 0.1 -0.02 0.003 0.004 0.03 0.04 0.01 -0.02",
    "RAD_TAN_THIN_PRISM_FISHEYE 320 240 200 210 162 117 "
    "0.1 -0.02 0.03 0.01 0.02 0.01 0.003 0.004 0.01 -0.02 0.01 0.02",
]


def test_every_model_that_is_named_as_known_is_tested():
    tested = [*(line.split()[0] for line in LENSES), PANORAMA]  # see test_panoramas.py
    assert sorted(CAMERA_MODELS) == sorted(tested)


@pytest.mark.parametrize(
    "size", [(320, 240), pytest.param((163, 122), marks=pytest.mark.slow)], ids=["whole", "half"]
)
@pytest.mark.parametrize("line", LENSES, ids=lambda line: line.split()[0])
def test_points_lie_where_the_pinhole_says(scene, line, size):
    """In images of the camera's size and of half of it, rounded; COLMAP projects the points."""
    with_camera(scene, line)
    camera = pycolmap.Reconstruction(scene / "sparse/0").cameras[1]
    scale = np.array(size) / (camera.width, camera.height)
    rays = np.array([(0.0, 0, 1), (-0.5, -0.35, 1), (0.5, -0.35, 1), (-0.5, 0.4, 1), (0.5, 0.4, 1)])
    rows, columns = np.indices(size[::-1]) + 0.5
    spread = 3 * scale.max()  # radius of a dot, in pixels
    for index, (x, y) in enumerate(camera.img_from_cam(rays) * scale):
        dot = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * spread**2))
        Image.fromarray(np.round(255 * dot).astype(np.uint8)).save(scene / f"images/{index}.png")
    posed = read(scene)
    assert posed.images[0].lens.model == line.split()[0]
    views = FileSequence(posed, SceneOptions(*size[::-1])).views(range(len(rays)))
    expected = views.cameras.intrinsics.double().numpy() @ rays[..., None]
    weights = views.images[:, 0].double().numpy() ** 2
    for weight, position in zip(weights, expected[:, :2, 0], strict=True):
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        assert np.abs(found - position).max() < 0.1


def test_every_image_has_its_own_camera(scene, views):
    edit(
        scene / "sparse/0/cameras.txt",
        lambda text: text.replace("\n3 PINHOLE", "\n3 SIMPLE_PINHOLE 32 24 50 16 12 #"),
    )
    focals = [image.lens.fx for image in read(scene).images]
    assert focals[2] == 50 and focals[1] == pytest.approx(views.cameras.intrinsics[1, 0, 0].item())


def test_intrinsics_are_scaled_to_smaller_images(scene):
    (scene / "images").rename(scene / "images_4")
    with_camera(scene, "OPENCV 130 97 120 124 60 44 0.1 0 0 0")
    lens = read(scene).images[0].lens
    x, y = 32 / 130, 24 / 97
    assert lens == Lens(32, 24, 120 * x, 124 * y, 60 * x, 44 * y, "OPENCV", (0.1, 0.0, 0.0, 0.0))


def test_images_of_the_full_size_are_preferred(scene):
    shutil.copytree(scene / "images", scene / "images_2")
    assert read(scene).images[0].file == scene / "images/0.png"
    for name in ("0.png", "1.png"):
        (scene / "images" / name).unlink()
    assert read(scene).images[0].file == scene / "images_2/0.png"


def test_names_may_have_folders_and_any_letters(scene, views):
    (scene / "images/左cam").mkdir()
    (scene / "images/3.png").rename(scene / "images/左cam/ä3.png")
    edit(scene / "sparse/0/images.txt", lambda text: text.replace("3.png", "左cam/ä3.png", 1))
    posed = read(scene)
    expected = views.cameras.cam_to_world[3].double().numpy()
    (image,) = (image for image in posed.images if image.file.name == "ä3.png")
    np.testing.assert_allclose(image.cam_to_world, expected, atol=1e-6)
    assert names_of(read(as_binary(scene))) == names_of(posed)


def test_a_warning_lists_images_that_are_not_registered(scene, views):
    for index in range(50, 57):
        save_image(scene / f"images/{index}.png", views.images[0])
    with pytest.warns(UserWarning) as caught:
        posed = read(scene)
    message = str(caught.list[0].message)
    assert len(caught) == 1 and "not registered 7 of 19" in message
    assert "50.png, 51.png, 52.png, 53.png, 54.png, ...; photograph what lies between" in message
    assert len(posed.images) == 12


@table(
    {
        "a camera model of no name": (
            lambda scene: with_camera(scene, "FOO 32 24 30 31 15 11"),
            "a camera model that is not known: .* or use one of SIMPLE_PINHOLE, ",
        ),
        "another shape": (
            lambda scene: with_camera(scene, "PINHOLE 64 40 60 60 32 20"),
            r"12 of 12 .*\n.*0\.png is 32 x 24 and .* for 64 x 40",
        ),
        "no image registered": (
            lambda scene: (scene / "sparse/0/images.txt").write_text(""),
            "registers no image",
        ),
        "no images": (
            lambda scene: shutil.rmtree(scene / "images"),
            r"names 12 images, such as 0\.png, and .* none of them: give the folder that holds the",
        ),
    }
)
@pytest.mark.filterwarnings("ignore:the images and points")
def test_a_scene_that_cannot_be_used_is_refused(scene, damage, message):
    damage(scene)
    with pytest.raises(InputError, match=message):
        read(scene)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_model_that_is_cut_short_is_refused(scene, name):
    file = as_binary(scene, old=True) / "sparse/0" / f"{name}.bin"
    stored = file.read_bytes()
    file.write_bytes(stored[: int(0.7 * len(stored))])
    with pytest.raises(InputError, match=r"sparse/0.*copy (it|its .* files) again"):
        read(scene)


def test_a_model_may_have_no_points(scene):
    (scene / "sparse/0/points3D.txt").write_text("")
    posed = read(scene)
    assert posed.points is None and len(posed.images) == 12


@pytest.mark.parametrize("change", ["moved", "scaled", "other images"])
def test_points_of_another_world_are_ignored(scene, change):
    posed = read(scene)
    poses = cameras_of(posed)
    if change == "moved":
        poses[:, 0, 3] += 0.05
    elif change == "scaled":
        poses[:, :3, 3] *= 1.05
    pairs = zip(posed.images, poses, strict=True)
    images = [replace(image, cam_to_world=pose) for image, pose in pairs]
    if change == "other images":
        edit(scene / "sparse/0/images.txt", lambda text: text.replace(".png", ".jpg"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert colmap.read_model_points(scene, images) is None


def test_points_with_other_numbers_than_in_the_images_are_read_without_their_tracks(scene):
    file, expected = scene / "sparse/0/points3D.txt", cameras_of(read(scene))
    lines = file.read_text().splitlines()
    points = [f"1{line}" for line in lines[3:]]
    file.write_text("\n".join((*lines[:2], *points)) + "\n")
    with pytest.warns(UserWarning, match="contradict each other"):
        posed = read(scene)
        assert len(posed.points) == len(points)
    np.testing.assert_allclose(cameras_of(posed), expected, atol=1e-12)


def test_quaternions_need_not_be_of_unit_length(scene):
    expected = cameras_of(read(scene))
    file = scene / "sparse/0/images.txt"
    lines = file.read_text().split("\n")
    first = next(n for n, line in enumerate(lines) if line and not line.startswith("#"))
    for number in range(first, len(lines), 2):
        fields = lines[number].split()
        fields[1:5] = (repr(1.04 * float(value)) for value in fields[1:5])
        lines[number] = " ".join(fields)
    file.write_text("\n".join(lines))
    for change in (lambda folder: folder, lambda folder: as_binary(folder, old=True)):
        poses = cameras_of(read(change(scene)))
        np.testing.assert_allclose(poses, expected, atol=1e-12)
        rotations = poses[:, :3, :3]
        identity = np.broadcast_to(np.eye(3), rotations.shape)
        np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), identity, atol=1e-12)
