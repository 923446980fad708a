import pytest
from layouts import assert_listed, assert_same, edit_json, opener
from layouts import long_lrm as layout

from asysplat.data import find_scenes

opened = opener("auto")


@pytest.fixture
def listed(views, tmp_path):
    return layout.write(views, tmp_path)


@pytest.fixture
def scene(listed):
    return listed.parent / "desk"


def change(scene, edit):
    edit_json(scene / "opencv_cameras.json", lambda content: edit(content["frames"]))
    return scene


def names_of(sequence):
    return [image.file.name for image in sequence.scene.images]


def test_a_scene_is_found_from_its_list_json_or_folder(listed, scene):
    file = scene / "opencv_cameras.json"
    assert find_scenes(listed) == find_scenes(file) == ("long_lrm", [file])
    assert find_scenes(scene) == find_scenes(listed.parent) == ("long_lrm", [scene])
    assert opened(listed).name == opened(scene).name == "desk"
    file.rename(scene / "cameras.json")
    assert find_scenes(scene / "cameras.json") == ("long_lrm", [scene / "cameras.json"])


def test_images_are_in_the_order_of_the_file(scene):
    names = [f"frame{10 * index}.png" for index in range(12)]
    assert names_of(opened(scene)) == names
    change(scene, lambda frames: frames.reverse())
    assert names_of(opened(scene)) == names[::-1]


def test_intrinsics_of_larger_images_are_scaled(scene, views):
    def enlarge(frames):
        for frame in frames:
            for name in ("fx", "fy", "cx", "cy", "w", "h"):
                frame[name] *= 4

    assert_same(opened(change(scene, enlarge)).cameras.intrinsics, views.cameras.intrinsics)


def test_all_bad_images_are_listed_or_left_out(scene):
    def damage(frames):
        frames[2]["w2c"][0][3] = float("nan")
        del frames[5]["cy"]

    sequence = assert_listed(
        opened,
        change(scene, damage),
        "frame 2 (images_undistort/frame20.png): w2c is not 4x4 or holds NaN",
        "image 5 cannot be read (KeyError('cy'))",
        total=12,
    )
    assert names_of(sequence) == [f"frame{10 * index}.png" for index in (0, 1, 3, 4, *range(6, 12))]
