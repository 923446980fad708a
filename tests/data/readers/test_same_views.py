"""One scene, written in every layout and read back."""

from importlib import import_module
from pkgutil import iter_modules

import layouts
import pytest
import torch

from asysplat.data import SceneOptions, find_scenes, open_scene

NAMES = [module.name for module in iter_modules(layouts.__path__)]


@pytest.mark.parametrize("name", NAMES)
def test_every_layout_gives_the_same_views(name, views, centerd_views, tmp_path):
    layout = import_module(f"layouts.{name}")
    expected = views if getattr(layout, "FREE_INTRINSICS", True) else centerd_views
    root = layout.write(expected, tmp_path / "scène 1")
    found, scenes = find_scenes(root)
    assert found == name and len(scenes) == 1
    height, width = expected.images.shape[-2:]
    sequence = open_scene(scenes[0], SceneOptions(height, width, name))
    assert sequence.num_images == expected.num_views
    read = sequence.views(range(sequence.num_images)).validate()

    def same(found, wanted):
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)

    same(read.images, expected.images)
    same(read.cameras.intrinsics, expected.cameras.intrinsics)
    same(read.cameras.cam_to_world, expected.cameras.cam_to_world)
    if getattr(layout, "HAS_DEPTHS", True):
        same(read.depths, expected.depths)
    else:
        assert read.depths is None
    assert read.masks is None or bool(read.masks.all())
