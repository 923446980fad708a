import pytest
import torch
from layouts import assert_listed, assert_same, edit_json, opener, save_image, table
from layouts.dl3dv import HASH, LENS, write, write_benchmark, write_scene

from asysplat.data.readers import dl3dv
from asysplat.errors import InputError

opened = opener("dl3dv")


@pytest.fixture
def scene(few, tmp_path):
    return write(few, tmp_path / "多視点") / "1K" / HASH


def test_scenes_are_named_by_their_hash(few, scene, tmp_path):
    assert dl3dv.find_scenes(scene.parents[1]) == dl3dv.find_scenes(scene) == [scene]
    assert opened(scene).name == HASH
    benchmark = write_benchmark(few, tmp_path / "benchmark") / HASH
    assert dl3dv.find_scenes(benchmark.parent) == [benchmark]
    assert opened(benchmark).name == opened(benchmark / "nerfstudio").name == HASH
    read = opened(benchmark).views(range(4))  # at 960P
    assert_same(read.images, few.images)
    assert_same(read.cameras.intrinsics, few.cameras.intrinsics)


def test_smaller_images_are_read_where_there_are_no_others_with_the_same_distortion(few, tmp_path):
    lens = LENS | {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": -0.004}
    write_scene(few, tmp_path / HASH, level=8, lens=lens)
    sequence = opened(tmp_path / HASH)
    found = sequence.scene.images[0].lens
    assert (found.width, found.height) == (16, 12)
    assert (found.model, found.distortion) == ("OPENCV", (0.1, -0.02, 0.003, -0.004))
    assert_same(sequence.cameras.intrinsics, few.cameras.intrinsics)
    write_scene(few, tmp_path / HASH, lens=lens)
    views = opened(tmp_path / HASH).views([0])
    assert views.masks is not None and (views.images - few.images[:1]).abs().max() > 0.01


def test_users_nerfstudio_scenes_are_not_read(few, tmp_path):
    folder = tmp_path / "desk"
    write_scene(few, folder)
    assert dl3dv.find_scenes(folder) == [folder]
    (folder / "images").mkdir()
    assert dl3dv.find_scenes(folder) == []


def test_an_image_of_another_size_is_named_or_left_out(scene):
    save_image(scene / "images_4/frame_00003.png", torch.ones(3, 12, 16))
    assert_listed(opened, scene, "frame_00003.png is 16 x 12")


def change(edit):
    return lambda scene: edit_json(scene / "transforms.json", edit)


@table(
    {
        "no images": (
            lambda scene: (scene / "images_4").rename(scene / "frames"),
            "has no folder images_4, images_8, images_2",
        ),
        "other proportions": (change(lambda content: content.update(h=128)), "has 0 usable image"),
    }
)
def test_a_broken_scene_is_refused(scene, damage, message):
    damage(scene)
    with pytest.raises(InputError, match=message):
        opened(scene, on_error="skip")
