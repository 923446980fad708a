"""Scenes far from the origin: moved there in float64, with the offset in the files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from asysplat import Views, read_gaussians
from asysplat.data import ProceduralScene, SceneOptions
from asysplat.data.images import Lens
from asysplat.data.normalize import normalize
from asysplat.data.sequence import FileSequence, PosedImage, PosedScene, near_origin
from asysplat.export import write_ply, write_safetensors

OPTIONS = SceneOptions(8, 8)


def scene_at(offset, scale=1.0):
    cameras = ProceduralScene(3, 8, 8, num_images=12).cameras
    lens = Lens(8, 8, 9.0, 9.0, 4.0, 4.0)
    poses = cameras.cam_to_world.double().numpy()
    poses[:, :3, 3] = scale * poses[:, :3, 3] + offset
    images = [PosedImage(Path(f"{i}.png"), lens, pose) for i, pose in enumerate(poses)]
    points = scale * np.random.default_rng(0).normal(size=(20, 3)) + offset
    return PosedScene("scene", images, lambda: points)


def network_poses(scene):
    cameras = FileSequence(scene, OPTIONS).cameras
    views = Views(cameras, torch.zeros(cameras.num_views, 3, 8, 8))
    return normalize(views, views)[0].cameras.cam_to_world


def test_a_geo_referenced_scene_is_the_same_to_the_network():
    offset = (5e5, 5.4e6, 300.0)
    expected, found = network_poses(scene_at((0, 0, 0))), network_poses(scene_at(offset))
    assert (found - expected).abs().max() < 2e-6
    moved = FileSequence(scene_at(offset), OPTIONS).scene
    assert moved.origin == tuple(np.round(moved.origin)) and np.abs(moved.points).max() < 20
    np.testing.assert_allclose(moved.points + moved.origin, scene_at(offset).points, atol=1e-8)
    subset = FileSequence(moved, OPTIONS).with_images(moved.images[:3])
    assert subset.scene.origin == moved.origin


def test_scenes_near_the_origin_keep_their_bits():
    scene = scene_at((3, -2, 50))
    assert near_origin(scene) is scene and scene.origin == (0, 0, 0)
    still = replace(scene, images=[scene.images[0]] * 3)
    assert near_origin(still) is still


@pytest.mark.parametrize("name", ["scene.ply", "scene.safetensors"])
def test_files_of_gaussians_are_read_around_another_origin(make_scene, tmp_path, name):
    gaussians, _ = make_scene(count=9, dtype=torch.float32)
    offset, file = (500004.0, 5399999.0, 300.0), tmp_path / name
    if name == "scene.ply":
        write_ply(file, gaussians, offset)
        assert b"comment offset 500004.0 5399999.0 300.0\n" in file.read_bytes()
    else:
        write_safetensors(file, gaussians, {"offset": " ".join(map(repr, offset))})
    torch.testing.assert_close(read_gaussians(file).means, gaussians.means)
    around = read_gaussians(file, (500000.0, 5400000.0, 300.0)).means
    torch.testing.assert_close(around, gaussians.means + torch.tensor([4.0, -1.0, 0.0]))
    assert torch.equal(read_gaussians(file, offset).means, gaussians.means)
