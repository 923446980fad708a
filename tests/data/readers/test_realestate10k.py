import json
import os
from pathlib import Path

import pytest
import torch
from layouts import assert_listed, assert_same, opener, table
from layouts.realestate10k import KEY, cameras, encoded, scene, write

from asysplat.data.readers import realestate10k
from asysplat.errors import InputError

MAPS = Path("/proc/self/maps")
opened = opener("realestate10k")


@pytest.fixture
def chunk(few, tmp_path):
    """Write a chunk of one scene after `change(scene)`; return its path."""

    def save(change=lambda scene: None):
        content = scene(few)
        change(content)
        file = tmp_path / "höfe/000000.torch"
        file.parent.mkdir()
        torch.save([content], file)
        return file

    return save


def test_scenes_are_found_by_the_index_by_chunk_and_by_address(few, tmp_path):
    root = write(few, tmp_path)
    address = tmp_path / "test/000000.torch" / KEY
    for named in (root, root / "test", root / "test/000000.torch", address):
        assert realestate10k.find_scenes(named) == [address]
    assert opened(address).name == KEY
    (root / "test/index.json").write_text(json.dumps({KEY: "000000.torch", "other": "1.torch"}))
    with pytest.raises(InputError, match=r"index.json names 1.torch, which does not exist"):
        realestate10k.find_scenes(root)


def test_scenes_of_chunks_without_an_index_are_found(few, tmp_path):
    torch.save([scene(few, "b"), scene(few, "a")], tmp_path / "000001.torch")
    torch.save([scene(few, "c")], tmp_path / "000000.torch")
    found = realestate10k.find_scenes(tmp_path)
    names = ["000000.torch/c", "000001.torch/b", "000001.torch/a"]
    assert found == [tmp_path / name for name in names]
    (tmp_path / "images").mkdir()
    assert realestate10k.find_scenes(tmp_path / "images") == []


def test_intrinsics_hold_for_any_size_of_image(few, chunk):
    def half(content):
        content["images"] = [encoded(image[:, ::2, ::2]) for image in few.images]

    assert_same(opened(chunk(half) / KEY).cameras.intrinsics, few.cameras.intrinsics)


def test_a_chunk_that_changes_is_read_again_also_in_the_format_before_zip_files(few, chunk):
    file = chunk()
    assert opened(file / KEY).num_images == 4
    torch.save([scene(few.select([0, 1]))], file, _use_new_zipfile_serialization=False)
    assert_same(opened(file / KEY).views(range(2)).images, few.images[:2])


def set_camera(column, value):
    return lambda content: content["cameras"][2].__setitem__(column, value)


@table(
    {
        "no rotation": (set_camera(6, 2.0), "frame 2: world-to-camera is not a rotation"),
        "distortion": (set_camera(4, 0.1), "frame 2: its image is distorted"),
        "cut short": (
            lambda content: content["images"].__setitem__(2, torch.arange(99).byte()),
            "frame 2 cannot be read as an image",
        ),
    }
)
def test_a_bad_image_is_named_or_left_out(chunk, damage, message):
    assert_listed(opened, chunk(damage) / KEY, message)


class Code:
    """Unpickling it makes a folder."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def test_code_in_a_chunk_is_not_run(few, tmp_path):
    file, made = tmp_path / "000000.torch", tmp_path / "made"
    content = {**scene(few), "url": Code(made)}
    torch.save([content], file)
    with pytest.raises(InputError, match=r"000000.torch cannot be read as tensors alone"):
        opened(file / KEY)
    assert not made.exists()
    torch.load(file, weights_only=False)
    assert made.exists()  # so it would have run


@pytest.mark.skipif(not MAPS.exists(), reason="needs Linux's list of mapped files")
def test_bytes_stay_in_the_file(few, chunk):
    file = chunk()
    image = opened(file / KEY).scene.images[1].file
    assert image.read() == bytes(encoded(few.images[1]).numpy())
    mapped = [line.split()[0].split("-") for line in MAPS.open() if str(file) in line]
    address = image.read.__self__.ctypes.data
    assert any(int(start, 16) <= address < int(end, 16) for start, end in mapped)


def test_cameras_are_pixelsplat_s(few):
    """The writer above against the columns as pixelSplat documents them."""
    row = cameras(few)[1]
    matrix = few.cameras.intrinsics[1]
    assert row[0] == matrix[0, 0] / 32 and row[3] == matrix[1, 2] / 24
    world_to_cam = row[6:].reshape(3, 4)
    center = few.cameras.cam_to_world[1, :3, 3]
    assert (world_to_cam[:, :3] @ center + world_to_cam[:, 3]).abs().max() < 1e-5
