import json
from pathlib import Path

import pytest
import torch
from layouts import save_image
from layouts.dl3dv import HASH, LENS, write, write_benchmark, write_scene

from asysplat.data import SceneOptions, open_scene
from asysplat.data.readers import dl3dv
from asysplat.errors import InputError


@pytest.fixture
def few(views):
    return views.select(range(4))


@pytest.fixture
def scene(few, tmp_path):
    return write(few, tmp_path / "多視点") / "1K" / HASH


def opened(path, height=24, width=32, **options):
    return open_scene(path, SceneOptions(height, width, layout="dl3dv", **options))


def change(scene, edit):
    file = scene / "transforms.json"
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def test_scenes_are_named_by_their_hash(few, scene, tmp_path):
    assert dl3dv.find_scenes(scene.parents[1]) == dl3dv.find_scenes(scene) == [scene]
    assert opened(scene).name == HASH
    benchmark = write_benchmark(few, tmp_path / "benchmark") / HASH
    assert dl3dv.find_scenes(benchmark.parent) == [benchmark]
    assert opened(benchmark).name == opened(benchmark / "nerfstudio").name == HASH


def test_the_benchmark_is_read_at_960p(few, tmp_path):
    sequence = opened(write_benchmark(few, tmp_path) / HASH)
    read = sequence.views(range(4))
    torch.testing.assert_close(read.images, few.images, rtol=0, atol=1e-5)
    torch.testing.assert_close(read.cameras.intrinsics, few.cameras.intrinsics, rtol=0, atol=1e-5)


def test_smaller_images_are_read_where_there_are_no_others(few, tmp_path):
    write_scene(few, tmp_path / HASH, level=8)
    sequence = opened(tmp_path / HASH)
    lens = sequence.scene.images[0].lens
    assert (lens.width, lens.height) == (16, 12)
    torch.testing.assert_close(
        sequence.cameras.intrinsics, few.cameras.intrinsics, rtol=0, atol=1e-5
    )


def test_distortion_does_not_depend_on_the_images_size(few, tmp_path):
    lens = LENS | {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": -0.004}
    write_scene(few, tmp_path / HASH, lens=lens)
    sequence = opened(tmp_path / HASH)
    assert sequence.scene.images[0].lens.distortion == (0.1, -0.02, 0.003, -0.004, 0)
    views = sequence.views([0])
    assert views.masks is not None and (views.images - few.images[:1]).abs().max() > 0.01


def test_nerfstudio_s_own_captures_are_not_taken(few, tmp_path):
    folder = tmp_path / "desk"
    write_scene(few, folder)
    assert dl3dv.find_scenes(folder) == [folder]
    (folder / "images").mkdir()
    assert dl3dv.find_scenes(folder) == []


def set_frame(**values):
    return lambda scene: change(scene, lambda content: content["frames"][2].update(values))


def nan(scene):
    def edit(content):
        content["frames"][2]["transform_matrix"][1][3] = float("nan")

    change(scene, edit)


def cut(scene):
    image = scene / "images_4/frame_00003.png"
    image.write_bytes(image.read_bytes()[:300])


FRAMES = {
    "missing": (lambda scene: (scene / "images_4/frame_00003.png").unlink(), "003.png does not"),
    "cut short": (cut, "frame_00003.png cannot be read"),
    "empty": (
        lambda scene: (scene / "images_4/frame_00003.png").write_bytes(b""),
        "frame_00003.png is empty",
    ),
    "portrait": (
        lambda scene: save_image(scene / "images_4/frame_00003.png", torch.ones(3, 32, 24)),
        "24 x 32",
    ),
    "another size": (
        lambda scene: save_image(scene / "images_4/frame_00003.png", torch.ones(3, 12, 16)),
        "frame_00003.png is 16 x 12",
    ),
    "nan": (nan, r"frame 2 \(images_4/frame_00003.png\): transform_matrix holds NaN"),
    "no pose": (set_frame(transform_matrix=None), "transform_matrix is not 4x4"),
    "no path": (set_frame(file_path=None), "frame 2 has no file_path"),
}


@pytest.mark.parametrize("damage, message", FRAMES.values(), ids=FRAMES.keys())
def test_a_bad_frame_is_named_or_left_out(scene, damage, message):
    damage(scene)
    with pytest.raises(InputError, match=f"1 of 4 images cannot be used(.|\n)*{message}"):
        opened(scene)
    with pytest.warns(UserWarning, match=f"left out 1 of 4 images(.|\n)*{message}"):
        assert opened(scene, on_bad_image="skip").num_images == 3


def test_all_bad_frames_are_told_together(scene):
    nan(scene)
    (scene / "images_4/frame_00002.png").unlink()
    with pytest.raises(InputError, match=r"2 of 4 images(.|\n)*002.png does(.|\n)*holds NaN"):
        opened(scene)


def test_other_proportions_of_all_images_are_refused(scene):
    change(scene, lambda content: content.update(h=4 * 32))
    with pytest.raises(InputError, match="4 of 4 images cannot be used"):
        opened(scene)


SCENES = {
    "no images": (
        lambda scene: (scene / "images_4").rename(scene / "frames"),
        "has no folder images_4, images_8, images_2",
    ),
    "no transforms": (
        lambda scene: (scene / "transforms.json").unlink(),
        "transforms.json does not exist",
    ),
    "no frames": (
        lambda scene: change(scene, lambda content: content.pop("frames")),
        'has no list "frames"',
    ),
}


@pytest.mark.parametrize("damage, message", SCENES.values(), ids=SCENES.keys())
def test_a_broken_scene_is_refused(scene: Path, damage, message):
    damage(scene)
    with pytest.raises(InputError, match=message):
        opened(scene, on_bad_image="skip")
