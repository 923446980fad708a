"""Cameras in front of textured surfaces, with the depth of every pixel."""

import math

import torch
from torch import Tensor

from asysplat.scene import Cameras

HEIGHT, WIDTH = 24, 32


def turned(cameras: Cameras, degrees: float) -> Cameras:
    """Rotate each camera about its vertical axis."""
    angle = math.radians(degrees)
    turn = torch.eye(4).to(cameras.cam_to_world)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    return Cameras(cameras.intrinsics, cameras.cam_to_world @ turn, cameras.height, cameras.width)


def cameras_at(
    centers: list[tuple[float, float, float]],
    focal: float = 1.0,
    height: int = HEIGHT,
    width: int = WIDTH,
    scenes: int = 1,
) -> Cameras:
    """Cameras that look along z in float64; the focal length is in image widths."""
    cam_to_world = torch.eye(4, dtype=torch.float64).repeat(scenes, len(centers), 1, 1)
    cam_to_world[..., :3, 3] = torch.tensor(centers, dtype=torch.float64)
    pixels = focal * width
    intrinsics = torch.tensor(
        [[pixels, 0, width / 2], [0, pixels, height / 2], [0, 0, 1]], dtype=torch.float64
    )
    return Cameras(intrinsics.expand(scenes, len(centers), 3, 3), cam_to_world, height, width)


def four_cameras(height: int = HEIGHT, width: int = WIDTH, scale: float = 1.0) -> Cameras:
    """Four cameras at the corners of a square."""
    side = 0.3 * scale
    corners = [(0.0, 0.0, 0.0), (side, 0.0, 0.0), (0.0, side, 0.0), (side, side, 0.1 * scale)]
    return cameras_at(corners, height=height, width=width)


def depth_of_plane(cameras: Cameras, distance: float, slant: float = 0.0) -> tuple[Tensor, Tensor]:
    """Depth and points of the plane z = distance + slant x; [B, V, H, W] and [B, V, H, W, 3]."""
    rotation = cameras.cam_to_world[..., None, None, :3, :3]
    directions = (rotation * cameras.pixel_directions()[..., None, :]).sum(-1)
    origins = cameras.centers[..., None, None, :].expand_as(directions)
    missing = distance + slant * origins[..., 0] - origins[..., 2]
    depth = missing / (directions[..., 2] - slant * directions[..., 0])
    return depth, origins + depth[..., None] * directions


def texture(points: Tensor, scale: float = 1.0, seed: int = 0) -> Tensor:
    """RGB of points [B, V, H, W, 3]: waves in x and y of a quarter unit and more, [B, V, 3, H, W].

    A unit is `scale` long.
    """
    generator = torch.Generator().manual_seed(seed)
    waves = torch.randn(3, 20, 2, generator=generator, dtype=torch.float64) * 8
    phases = torch.rand(3, 20, generator=generator, dtype=torch.float64) * 2 * math.pi
    angles = torch.einsum("bvhwi,cni->bvcnhw", points[..., :2] / scale, waves)
    return (0.5 + 0.08 * torch.sin(angles + phases[..., None, None]).sum(3)).clamp(0, 1)


def slanted_plane(cameras: Cameras, distance: float = 3.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Images and depths of a textured plane at about this distance; waves as wide in the image."""
    depth, points = depth_of_plane(cameras, distance, slant=0.3)
    focal = (cameras.intrinsics[..., 0, 0] / cameras.width).mean().item()
    return texture(points, scale=distance / (3 * focal), seed=seed), depth


def maps_of(estimate):
    """All maps of a DepthEstimate by name."""
    votes = estimate.votes._asdict()
    return {"inverse_depth": estimate.inverse_depth, "confidence": estimate.confidence} | votes
