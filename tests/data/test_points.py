"""Depths of sparse points: projection, occlusion, and point depths of a task's inputs."""

import numpy as np
import pytest
import torch

from asysplat.data.datamodule import SceneDataModule, TrainingTasks, collate, load
from asysplat.data.normalize import depths_of_points
from asysplat.data.procedural import ProceduralScene
from asysplat.data.selection import Selection
from asysplat.data.sources import Task
from asysplat.scene import Cameras

SIZE = 32


def camera_at_origin(views: int = 1) -> Cameras:
    intrinsics = torch.tensor([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]).repeat(views, 1, 1)
    return Cameras(intrinsics, torch.eye(4).repeat(views, 1, 1), SIZE, SIZE)


def wall(z: float, right: int, first: int) -> np.ndarray:
    """Points of a wall up to column `right`, in every fourth column and row from `first` on."""
    x, y = np.meshgrid(np.arange(first, right, 4) + 0.5, np.arange(first, SIZE, 4) + 0.5)
    return np.stack(((x - 16) / 32 * z, (y - 16) / 32 * z, np.full_like(x, z)), -1).reshape(-1, 3)


class SequenceWithPoints:
    """A synthetic scene and sparse points of the surfaces that one of its frames sees."""

    def __init__(self, frame: int):
        self.scene = ProceduralScene(3, SIZE, SIZE, num_images=24)
        self.name, self.cameras, self.num_images = "scene", self.scene.cameras, 24
        views = self.scene.views([frame])
        y, x = torch.meshgrid(torch.arange(2, SIZE, 4), torch.arange(2, SIZE, 4), indexing="ij")
        depth = views.depths[0, y, x][..., None]
        local = views.cameras.pixel_directions()[0, y, x] * depth
        pose = views.cameras.cam_to_world[0]
        points = (local @ pose[:3, :3].T + pose[:3, 3])[depth[..., 0] > 0]
        self.points = points.double().numpy()

    def views(self, frames):
        return self.scene.views(frames)


def test_a_pixel_has_the_depth_of_its_nearest_point():
    cameras = camera_at_origin(2)
    cameras.cam_to_world[1, 0, 3] = 0.5
    seen, farther, beside, behind = (0.1, 0.1, 2), (0.12, 0.12, 2.2), (9, 0, 1), (0, 0, -1)
    points = [farther, seen, beside, behind, (0, 0, 0), (np.nan, 0, 1), (np.inf, 0, np.inf)]
    depths = depths_of_points(np.array(points, dtype=float), cameras)
    assert depths[0].count_nonzero() == 1 and depths[0, 17, 17] == 2
    assert depths[1, 17, 9] == 2
    none = depths_of_points(np.zeros((0, 3)), cameras)
    assert none.shape == (2, SIZE, SIZE) and not none.any()


def test_a_sparse_wall_occludes_points():
    """A wall at depth 2 in the left half, and behind it one at 5 in the whole image."""
    front, back = wall(2, 16, first=0), wall(5, SIZE, first=2)
    alone = depths_of_points(back, camera_at_origin())[0]
    both = depths_of_points(np.concatenate((front, back)), camera_at_origin())[0]
    assert (alone[:, :16] == 5).sum() == 8 * 4
    assert (both == 2).sum() == len(front)
    assert not (both[:, :12] == 5).any()
    assert torch.equal(both[:, 20:], alone[:, 20:])


def test_a_slanted_surface_keeps_its_points():
    """A floor that leaves the camera at a height of 1, from depth 2 on."""
    x, z = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(2.1, 12, 200))
    floor = np.stack((x, np.ones_like(x), z), -1).reshape(-1, 3)
    cameras = camera_at_origin()
    seen = depths_of_points(floor, cameras)[0]
    column, row = (16 + 32 * floor[:, i] / floor[:, 2] for i in (0, 1))
    inside = (column >= 0) & (column < SIZE) & (row >= 0) & (row < SIZE)
    pixels = np.unique(row[inside].astype(int) * SIZE + column[inside].astype(int))
    assert (seen > 0).sum() > 0.85 * len(pixels)


def test_loaded_inputs_have_point_depths_in_their_own_frame():
    sequence = SequenceWithPoints(frame=5)
    task = Task(sequence, Selection([9, 5, 1], [7]))
    plain = load(task, crop=0.8)
    sample = load(task, crop=0.8, points=True)
    inputs = sample["inputs"].validate()
    assert sample["targets"].point_depths is None
    known = inputs.point_depths > 0
    assert all(count > 10 for count in known.sum((1, 2)))
    difference = inputs.point_depths[known] / inputs.depths[known] - 1
    assert difference.abs().median() < 0.02
    for views in ("inputs", "targets"):
        assert plain[views].point_depths is None
        assert torch.equal(plain[views].images, sample[views].images)
        assert torch.equal(plain[views].depths, sample[views].depths)
        poses = [each[views].cameras.cam_to_world for each in (plain, sample)]
        assert torch.equal(*poses)
    assert collate([sample, sample])["inputs"].point_depths.shape == (2, 3, SIZE, SIZE)
    assert collate([sample, plain])["inputs"].point_depths is None


class OneTask:
    def __init__(self, sequence):
        self.task = Task(sequence, Selection([1, 5, 9], [3]))

    def training(self, inputs, targets, rng, grown):
        return self.task

    def evaluation(self, split, inputs, targets):
        return [self.task]


def make_data(sequence, points: bool) -> SceneDataModule:
    size = {"inputs": 3, "targets": 1, "height": SIZE, "width": SIZE, "batch_size": 1}
    options = {"num_workers": 0, "seed": 0, "steps_per_epoch": 1, "points": points}
    return SceneDataModule("data", OneTask(sequence), **size, **options)


def test_points_are_optional_and_a_scene_without_points_is_reported():
    for asked in (True, False):
        data = make_data(SequenceWithPoints(5), points=asked)
        data.setup()
        samples = [TrainingTasks(data)[0], data.evaluation["test"][0]]
        given = [sample["inputs"].point_depths is not None for sample in samples]
        assert given == [asked, asked]
    data = make_data(ProceduralScene(3, SIZE, SIZE, num_images=24), points=True)
    with pytest.warns(UserWarning, match="no sparse points of"):
        data.setup()
    assert data.evaluation["test"][0]["inputs"].point_depths is None
