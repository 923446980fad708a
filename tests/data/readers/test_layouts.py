"""One scene, written in every layout: read back, and with damaged files."""

from importlib import import_module
from pkgutil import iter_modules

import layouts
import numpy as np
import pytest
import torch
from layouts import assert_listed, assert_same, cut, opener, save_depth

from asysplat import open_photographs
from asysplat.data import FilesSource, SceneOptions, find_scenes
from asysplat.data.selection import Selection
from asysplat.errors import InputError

CUT = (".json", ".npy", ".npz", ".txt", ".bin", ".torch")  # files of cameras and points
NAMES = [module.name for module in iter_modules(layouts.__path__)]
FILES = [name for name in NAMES if name != "realestate10k"]  # which has images inside a file
DEPTHS = [name for name in NAMES if getattr(import_module(f"layouts.{name}"), "HAS_DEPTHS", True)]


@pytest.mark.parametrize("name", NAMES)
def test_every_layout_gives_the_same_views(name, views, centered_views, tmp_path):
    layout = import_module(f"layouts.{name}")
    expected = views if getattr(layout, "FREE_INTRINSICS", True) else centered_views
    root = layout.write(expected, tmp_path / "scène 1")
    detected, scenes = find_scenes(root)
    assert detected == name and len(scenes) == 1
    sequence = opener(name)(scenes[0])
    assert sequence.num_images == expected.num_views
    read = sequence.views(range(sequence.num_images)).validate()
    assert_same(read.images, expected.images)
    assert_same(read.cameras.intrinsics, expected.cameras.intrinsics)
    assert_same(read.cameras.cam_to_world, expected.cameras.cam_to_world)
    if name in DEPTHS:
        assert_same(read.depths, expected.depths)
    else:
        assert read.depths is None
    assert read.masks is None or bool(read.masks.all())


@pytest.mark.parametrize("name", NAMES)
def test_half_of_a_file_is_a_sentence(name, few, tmp_path):
    root = import_module(f"layouts.{name}").write(few, tmp_path)
    files = [path for path in tmp_path.rglob("*.*") if path.suffix in CUT and path.is_file()]
    assert files
    for file in files:
        stored = file.read_bytes()
        cut(file, len(stored) // 2)
        with pytest.raises(InputError, match=r"/.* (cannot|holds|is|has|names) "):
            _ = opener(name)(find_scenes(root, name)[1][0]).scene.points
        file.write_bytes(stored)


@pytest.mark.parametrize("name", FILES)
def test_an_image_that_is_cut_short_is_named_or_left_out(name, few, tmp_path):
    check_damage(name, few, tmp_path, "file", cut, "cannot be read as an image")


@pytest.mark.parametrize("name", DEPTHS)
def test_a_depth_map_of_other_proportions_is_named_or_left_out(name, few, tmp_path):
    def square(file):
        save_depth(file, torch.ones(8, 8))

    check_damage(name, few, tmp_path, "depth", square, "is 8 x 8 and the image 32 x 24")


def check_damage(name, views, folder, field, damage, message):
    _, (scene,) = find_scenes(import_module(f"layouts.{name}").write(views, folder))
    file = getattr(opener(name)(scene).scene.images[2], field)
    damage(file)
    assert_listed(opener(name), scene, f"{file} {message}")


@pytest.mark.parametrize("name", DEPTHS)
def test_depths_may_be_smaller(name, few, tmp_path):
    _, (scene,) = find_scenes(import_module(f"layouts.{name}").write(few, tmp_path))
    for image in opener(name)(scene).scene.images:
        save_depth(image.depth, torch.full((12, 16), 2.125))
    assert opener(name)(scene).views([0]).depths.unique().tolist() == [2.125]


def test_posediffusion_s_images_may_be_in_a_folder_and_each_has_a_camera(few, tmp_path):
    import_module("layouts.posediffusion").write(few, tmp_path)
    (tmp_path / "images").mkdir()
    for file in tmp_path.glob("*.png"):
        file.rename(tmp_path / "images" / file.name)
    assert opener("posediffusion")(tmp_path).num_images == 4
    (tmp_path / "images" / "frame000002.png").unlink()
    with pytest.raises(InputError, match=r"gt_cameras.npz has 4 cameras for 3 images: give one"):
        opener("posediffusion")(tmp_path)


def test_images_that_blender_s_scenes_test_are_held_out(centered_views, tmp_path):
    write = import_module("layouts.blender").write
    alphas = torch.ones(12, 24, 32)
    alphas[:, :8] = 0
    write(centered_views.select(range(8)), tmp_path, alphas=alphas)
    write(centered_views.select(range(8, 12)), tmp_path, "test", alphas)
    photographs = open_photographs(tmp_path, height=24, say=lambda text: None)
    assert photographs.is_split and photographs.background.tolist() == [1, 1, 1]
    names = [f"test/r_{index}.png" for index in range(4)]
    assert [file.removeprefix(f"{tmp_path}/") for file in photographs.held_out_files] == names
    assert photographs.inputs.num_views == 8 and (photographs.inputs.alphas[:, :8] == 0).all()
    assert (photographs.inputs.images[:, :, :8] == 255).all()
    alone = open_photographs(tmp_path, height=24, held_out_every=None, say=lambda text: None)
    assert alone.held_out is None and alone.inputs.num_views == 8
    source = FilesSource(str(tmp_path), SceneOptions(24, 32), window=None)
    (tested,), (validated,) = (source.evaluation(split, 4, 8) for split in ("test", "val"))
    assert tested.selection == Selection([0, 2, 5, 7], [8, 9, 10, 11])
    assert validated.selection == Selection([0, 2, 5, 7], [4])
    trained = [source.training(3, 2, np.random.default_rng(seed)).selection for seed in range(20)]
    assert {i for drawn in trained for i in drawn.inputs + drawn.targets} == {*range(8)} - {4}
