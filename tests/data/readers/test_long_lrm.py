import json

import pytest
from layouts import long_lrm as layout

from asysplat.data import SceneOptions, find_scenes, open_scene
from asysplat.errors import InputError

HEIGHT, WIDTH = 24, 32


@pytest.fixture
def listed(views, tmp_path):
    return layout.write(views, tmp_path)


@pytest.fixture
def scene(listed):
    return listed.parent / "desk"


def change(scene, edit):
    file = scene / "opencv_cameras.json"
    content = json.loads(file.read_text())
    edit(content["frames"])
    file.write_text(json.dumps(content))
    return scene


def names_of(sequence):
    return [photograph.file.name for photograph in sequence.scene.images]


def test_a_scene_is_found_from_its_list_json_or_folder(listed, scene):
    file = scene / "opencv_cameras.json"
    assert find_scenes(listed) == find_scenes(file) == ("long_lrm", [file])
    assert find_scenes(scene) == find_scenes(listed.parent) == ("long_lrm", [scene])
    assert {open_scene(path, SceneOptions(8, 8)).name for path in (listed, scene)} == {"desk"}
    file.rename(scene / "cameras.json")
    assert find_scenes(scene / "cameras.json") == ("long_lrm", [scene / "cameras.json"])


def test_other_text_and_json_files_are_no_scenes_of_it(scene, tmp_path):
    (tmp_path / "notes.txt").write_text("cameras.txt")
    (tmp_path / "other.json").write_text('{"frames": []}')
    for name in ("notes.txt", "other.json"):
        with pytest.raises(InputError, match="holds no scene of layout long_lrm"):
            find_scenes(tmp_path / name, "long_lrm")


def test_frames_are_in_the_file_s_order(scene):
    names = [f"frame{10 * index}.png" for index in range(12)]
    assert names_of(open_scene(scene, SceneOptions(8, 8))) == names
    change(scene, lambda frames: frames.reverse())
    assert names_of(open_scene(scene, SceneOptions(8, 8))) == names[::-1]


def test_intrinsics_of_larger_images_are_scaled(scene, views):
    def enlarge(frames):
        for frame in frames:
            for name in ("fx", "fy", "cx", "cy", "w", "h"):
                frame[name] *= 4

    sequence = open_scene(change(scene, enlarge), SceneOptions(HEIGHT, WIDTH))
    difference = sequence.cameras.intrinsics - views.cameras.intrinsics
    assert difference.abs().max() < 1e-5


def test_all_bad_frames_are_listed_or_skipped(scene):
    images = scene / "images_undistort"
    (images / "frame0.png").unlink()
    cut = images / "frame10.png"
    cut.write_bytes(cut.read_bytes()[:200])

    def damage(frames):
        frames[2]["w2c"][0][3] = float("nan")
        frames[3]["w2c"] = frames[3]["w2c"][:3]
        frames[4]["fx"] = 0
        del frames[5]["cy"]
        frames[6]["h"] = 20
        frames[7] = {}
        frames[8]["w"] = None

    with pytest.raises(InputError) as error:
        open_scene(change(scene, damage), SceneOptions(HEIGHT, WIDTH))
    summary, *sentences = str(error.value).splitlines()
    assert "9 of 12 images" in summary
    expected = [
        "frame0.png does not exist",
        "frame10.png cannot be read",
        "frame 2 (images_undistort/frame20.png): w2c holds NaN",
        "frame 3 (images_undistort/frame30.png): w2c is not 4x4",
        "frame 4 (images_undistort/frame40.png) has intrinsics 0,",
        "frame 5 (images_undistort/frame50.png) needs the numbers",
        "frame 6 (images_undistort/frame60.png) is 32 x 24 and its intrinsics are for 32 x 20",
        "frame 7 has no file_path",
        "frame 8 (images_undistort/frame80.png) needs the numbers",
    ]
    for sentence, part in zip(sentences, expected, strict=True):
        assert part in sentence
    with pytest.warns(UserWarning, match="left out 9 of 12"):
        sequence = open_scene(scene, SceneOptions(HEIGHT, WIDTH, on_bad_image="skip"))
    assert names_of(sequence) == ["frame90.png", "frame100.png", "frame110.png"]


def test_a_cut_json_is_refused(scene):
    file = scene / "opencv_cameras.json"
    file.write_text(file.read_text()[:1000])
    with pytest.raises(InputError, match=r"opencv_cameras\.json is not JSON"):
        open_scene(scene, SceneOptions(HEIGHT, WIDTH))


def test_a_listed_file_that_is_missing_is_refused(listed):
    listed.write_text("gone/opencv_cameras.json")
    with pytest.raises(InputError, match=r"gone/opencv_cameras\.json does not exist"):
        open_scene(listed, SceneOptions(HEIGHT, WIDTH))
