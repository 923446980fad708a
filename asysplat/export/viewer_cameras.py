"""Cameras of the viewer: of its clients, and of the frustums that they see."""

import math
from typing import Any

import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from asysplat.scene import MAX_FIELD_OF_VIEW, Cameras

MAX_SIDE = 16384  # pixels of a client's image
MIN_FOV, MAX_FOV = 1e-3, 2.9  # radians


def mean_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """Return the mean up direction, a unit vector; the first camera's where they cancel."""
    up = -cameras.cam_to_world[:, :3, 1]
    mean = up.mean(0)
    return normalize(mean if mean.norm() > 1e-3 else up[0], dim=0)


def field_of_view(cameras: Cameras, view: int) -> tuple[float, float]:
    """Return a camera's vertical field of view, in radians, and its aspect ratio, width/height."""
    focal_x, focal_y = cameras.intrinsics[view].diagonal()[:2].tolist()
    up, across = cameras.height / focal_y, cameras.width / focal_x
    return 2 * math.atan(up / 2), across / up


def quaternion(cameras: Cameras, view: int) -> ndarray:
    """Return a camera's rotation, wxyz."""
    rotation = cameras.cam_to_world[view, :3, :3].numpy()
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def clicked_camera(
    cameras: Cameras, length: float, start: Float[Tensor, "3"], ray: Float[Tensor, "3"]
) -> int | None:
    """Return the first camera whose image a ray, which ends at the near plane, hits behind it."""
    rotations = cameras.cam_to_world[:, :3, :3]
    starts = ((start - cameras.centers)[:, None] @ rotations)[:, 0]
    rays = ray @ rotations
    steps = (length - starts[:, 2]) / rays[:, 2]
    hits = (starts + steps[:, None] * rays)[:, :2]
    focal = cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2]
    half = length / 2 * focal.new_tensor([cameras.width, cameras.height]) / focal
    hit = (steps > 1) & (hits.abs() <= half).all(-1)
    return steps.where(hit, torch.inf).argmin().item() if hit.any() else None


def client_camera(client: Any, max_pixels: int) -> tuple[Cameras, bool]:
    """Return the camera of a page, viser's CameraHandle, and whether it has all pixels of it."""
    height, width = (
        min(max(side, 1), MAX_SIDE) for side in (client.image_height, client.image_width)
    )
    focal = height / 2 / math.tan(min(max(client.fov, MIN_FOV), MAX_FOV) / 2)
    width = max(1, min(width, int(MAX_FIELD_OF_VIEW * focal) - 1))
    cam_to_world = torch.eye(4)
    rotation = Rotation.from_quat(client.wxyz, scalar_first=True).as_matrix()
    cam_to_world[:3, :3] = torch.from_numpy(rotation)
    cam_to_world[:3, 3] = torch.from_numpy(client.position)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics[None], cam_to_world[None], height, width).validate("client")
    factor = math.sqrt(min(1, max_pixels / (height * width)))
    if factor == 1:
        return cameras, True
    return cameras.resized(max(round(factor * height), 1), max(round(factor * width), 1)), False
