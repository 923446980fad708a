"""Varied scenes, used in training: antialiased edges, gloss, paths, focal lengths."""

import numpy as np
import pytest
import torch
from torch.nn.functional import max_pool2d

from asysplat.data import ProceduralSource
from asysplat.data.procedural import ProceduralScene, split_seed
from asysplat.data.procedural.path import circle, forward, hand_held_path, pan
from asysplat.data.procedural.scene import SAMPLES, average_samples, edge_pixels, sample_directions

pytestmark = pytest.mark.usefixtures("one_thread")
SEEDS = range(3)


@pytest.mark.medium
def test_only_training_scenes_are_varied():
    source = ProceduralSource(16, 16, 24, (12, 24), val_scenes=1, test_scenes=1, varied=True)
    rng = np.random.default_rng(0)
    focals = [
        source.training(3, 1, rng).sequence.cameras.intrinsics[0, 0, 0].item() for _ in range(40)
    ]
    degrees = np.degrees(2 * np.arctan(8 / np.array(focals)))
    assert 25 <= degrees.min() < 35 and 70 < degrees.max() <= 80
    for split in ("val", "test"):
        (task,) = source.evaluation(split, 3, 1)
        plain = ProceduralScene(split_seed(split, 0), 16, 16, 24)
        assert torch.equal(task.sequence.views([5]).images, plain.views([5]).images)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_pixel_at_an_edge_lies_between_its_neighbors(seed):
    scene = ProceduralScene(seed, 48, 48, varied=True)
    smooth = scene.views([0, 60])
    scene._antialiased = False
    sharp = scene.views([0, 60])
    assert torch.equal(smooth.depths, sharp.depths)
    changed = (smooth.images != sharp.images).any(1)
    assert 0.01 < changed.float().mean() < 0.4
    brightest = max_pool2d(sharp.images, 3, 1, 1)
    darkest = -max_pool2d(-sharp.images, 3, 1, 1)
    assert (smooth.images < brightest + 1e-5).all() and (smooth.images > darkest - 1e-5).all()


def test_edge_pixels_match_their_coverage():
    """A white surface right of a slanted edge on black, where the exact coverage is known."""
    size, pixel = 32, 2 / 32

    def surface(directions):
        return (directions[0] > 0.3 * directions[1] + 0.01).long()

    y, x = torch.meshgrid(*2 * [torch.linspace(-1 + 1 / size, 1 - 1 / size, size)], indexing="ij")
    directions = torch.stack((x, y, torch.ones_like(x))).flatten(1)
    surfaces = surface(directions).view(size, size)
    light = surfaces.float().flatten().repeat(3, 1)
    edges = edge_pixels(surfaces)
    seen = surface(sample_directions(directions[:, edges], pixel))
    found = average_samples(light, surfaces, edges, seen)[0]
    fine = (torch.arange(40) + 0.5) / 40 - 0.5
    offsets = torch.cartesian_prod(fine, fine).T * pixel
    around = directions[:2, edges, None] + offsets[:, None]
    covered = surface(around).float().mean(1)
    assert len(SAMPLES) == 4 and set(found.tolist()) == {0, 0.25, 0.5, 0.75, 1}
    assert (found - covered).abs().max() < 0.26
    assert (found - covered).abs().mean() < 0.5 * (light[0, edges] - covered).abs().mean()


def turn(angles):
    return np.degrees(np.ptp(np.unwrap(angles)))


@pytest.mark.parametrize("seed", SEEDS)
def test_paths_turn_and_advance_as_they_are_named(seed):
    around, ahead, still = (
        hand_held_path(np.random.default_rng(seed), 96, 2.0, path)
        for path in (circle, forward, pan)
    )
    centers, gaze = around[:, :2, 3], around[:, :2, 2]
    assert 105 < turn(np.arctan2(*centers.T)) < 290
    assert (-(centers * gaze).sum(1) / np.linalg.norm(centers, axis=1) > 0.75).all()
    way = ahead[-1, :3, 3] - ahead[0, :3, 3]
    assert 1.4 < np.linalg.norm(way) < 4.2
    assert (ahead[:, :3, 2] @ way / np.linalg.norm(way) > 0.6).all()
    assert 45 < turn(np.arctan2(*still[:, :2, 2].T)) < 130
    assert np.ptp(still[:, :3, 3], axis=0).max() < 1.1
