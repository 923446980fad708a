"""Small posed images with exact depths, to be written in any layout and read back."""

from dataclasses import replace

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.scene import Views

HEIGHT, WIDTH = 24, 32


@pytest.fixture(scope="session")
def centered_views() -> Views:
    """Twelve views of a room with one focal length and the principal point at the center.

    Images are rounded to 8 bits and depths to whole millimeters.
    """
    scene = ProceduralScene(1, HEIGHT, WIDTH, num_images=40, places="rooms")
    views = scene.views(range(12))
    return replace(
        views,
        images=(views.images * 255).round() / 255,
        depths=(views.depths * 1000).round() / 1000,
    ).validate()


@pytest.fixture(scope="session")
def views(centered_views) -> Views:
    """The same with two focal lengths and the principal point off the center."""
    cameras = centered_views.cameras
    change = torch.tensor([[0.0, 0.0, 1.25], [0.0, 1.5, -2.5], [0.0, 0.0, 0.0]])
    return replace(centered_views, cameras=replace(cameras, intrinsics=cameras.intrinsics + change))


@pytest.fixture
def few(views) -> Views:
    """Four of the views."""
    return views.select(range(4))
