"""Small posed photographs with exact depths, to be written in any layout and read back."""

from dataclasses import replace

import pytest
import torch

from asysplat.data import ProceduralScene
from asysplat.scene import Views

HEIGHT, WIDTH = 24, 32


@pytest.fixture(scope="session")
def centerd_views() -> Views:
    """Twelve views of a room, 24 x 32, as 8-bit images and depths of whole millimeters can hold
    them; one focal length, and the principal point at the center."""
    scene = ProceduralScene(1, HEIGHT, WIDTH, num_images=40, places="rooms")
    views = scene.views(range(12))
    return replace(
        views,
        images=(views.images * 255).round() / 255,
        depths=(views.depths * 1000).round() / 1000,
    ).validate()


@pytest.fixture(scope="session")
def views(centerd_views) -> Views:
    """The same with two focal lengths and the principal point off the center."""
    cameras = centerd_views.cameras
    change = torch.tensor([[0.0, 0.0, 1.25], [0.0, 1.5, -2.5], [0.0, 0.0, 0.0]])
    cameras = replace(cameras, intrinsics=cameras.intrinsics + change)
    return replace(centerd_views, cameras=cameras)
