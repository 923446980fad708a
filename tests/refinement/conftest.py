"""Fixtures of several tests of the refinement."""

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.models.prior import Prior
from asysplat.refinement.init import SPREAD, merge_to_limit


@pytest.fixture(scope="session")
def room():
    """Photographs of a room with their depths: 12 to fit to, and 3 between them."""
    scene = ProceduralScene(1, 45, 60, 24, places="rooms")
    return scene.views(range(0, 24, 2)), scene.views(range(3, 24, 8))


@pytest.fixture(scope="session")
def small_room():
    return ProceduralScene(1, 24, 32, 12, places="rooms").views(range(0, 12, 3))


@pytest.fixture(scope="session")
def start(room):
    """Gaussians at the true surfaces, of a pixel in nine."""
    views = room[0]
    size = (views.cameras.height // 3, views.cameras.width // 3)
    length = views.cameras.resized(*size).pixel_directions().norm(dim=-1)
    depths = torch.nn.functional.interpolate(views.depths[None], size)[0]
    distance = (depths * length)[None]
    prior = Prior(distance, torch.full_like(distance, 0.5))
    placed = prior.gaussians(views.map(lambda tensor: tensor[None]), SPREAD)
    return merge_to_limit(placed.map(lambda tensor: tensor[0]), views.cameras, 4.0, 10_000)
