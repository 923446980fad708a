"""The frame that a page in the browser works in, and its cameras."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from asysplat.scene import Cameras, Gaussians

FRUSTUM = (0.03, 0.2)  # least and greatest length of a frustum, in the page's units


@dataclass(frozen=True)
class Frame:
    """The frame that pages work in: input cameras around 0, the farthest of them at distance 1.

    A browser's near plane, steps and float32 suit a scene of that size alone.

    Args:
        center: float64, in scene units.
        unit: scene units in one of the frame's.
    """

    center: Float[Tensor, "3"]
    unit: float

    @classmethod
    def of(cls, cameras: Cameras, gaussians: Gaussians | None) -> "Frame":
        """Return the frame of a scene; cameras in one place leave its unit to the Gaussians."""
        centers = cameras.centers.double().cpu()
        center = centers.mean(0)
        radius = (centers - center).norm(dim=-1).max()
        # Smaller differences between the centers are rounding.
        if radius > 1e-6 * centers.abs().max():
            return cls(center, radius.item())
        if gaussians is None:
            return cls(center, 1.0)
        return cls(center, (gaussians.means.double().cpu() - center).norm(dim=-1).median().item())

    def cameras(self, cameras: Cameras) -> Cameras:
        """Bring cameras into this frame, on the CPU."""
        cameras = cameras.to("cpu", torch.float64)
        poses = cameras.cam_to_world.clone()
        poses[:, :3, 3] = (poses[:, :3, 3] - self.center) / self.unit
        return replace(cameras, cam_to_world=poses).to(torch.float32)

    @torch.no_grad()
    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Copy Gaussians into this frame, on their device."""
        copy = gaussians.map(lambda tensor: tensor.to(torch.float32, copy=True))
        center = self.center.to(gaussians.means.device)
        means = ((gaussians.means.double() - center) / self.unit).float()
        return replace(copy, means=means, scales=copy.scales / self.unit)


def mean_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """Return the mean up direction, a unit vector; the first camera's where they cancel."""
    up = -cameras.cam_to_world[:, :3, 1]
    mean = up.mean(0)
    return normalize(mean if mean.norm() > 1e-3 else up[0], dim=0)


def frustum_length(cameras: Cameras) -> float:
    """Return half the usual distance from a camera to the next one, within FRUSTUM."""
    apart = torch.cdist(cameras.centers, cameras.centers)
    apart.fill_diagonal_(math.inf)
    usual = apart.amin(1).median().item()
    return min(max(0.5 * usual, FRUSTUM[0]), FRUSTUM[1])


def field_of_view(cameras: Cameras, view: int) -> tuple[float, float]:
    """Return a camera's vertical field of view, in radians, and its aspect ratio, across to up."""
    focal_x, focal_y = cameras.intrinsics[view].diagonal()[:2].tolist()
    up, across = cameras.height / focal_y, cameras.width / focal_x
    return 2 * math.atan(up / 2), across / up


def quaternion(cameras: Cameras, view: int) -> ndarray:
    """Return a camera's rotation, wxyz."""
    rotation = cameras.cam_to_world[view, :3, :3].numpy()
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def distance_along(
    gaussians: Gaussians, position: Float[Tensor, "3"], forward: Float[Tensor, "3"]
) -> float:
    """Return the median depth of the Gaussians within 45 degrees of a direction; 1 without any."""
    offsets = gaussians.means - position.to(gaussians.means)
    depths = offsets @ forward.to(gaussians.means)
    seen = depths > math.sqrt(0.5) * offsets.norm(dim=-1)
    return depths[seen].median().item() if seen.any() else 1.0


def pointed_at(
    cameras: Cameras, length: float, start: Float[Tensor, "3"], ray: Float[Tensor, "3"]
) -> int | None:
    """Return the camera whose photograph, at the end of its frustum, a ray meets first.

    Args:
        cameras: [V].
        length: of the frustums.
        start: where the ray begins.
        ray: to the near plane; what it meets before that is not drawn.

    Returns:
        None where it meets no photograph.
    """
    rotations = cameras.cam_to_world[:, :3, :3]
    starts = ((start - cameras.centers)[:, None] @ rotations)[:, 0]
    rays = ray @ rotations
    steps = (length - starts[:, 2]) / rays[:, 2]
    meets = (starts + steps[:, None] * rays)[:, :2]
    focal = cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2]
    half = length / 2 * focal.new_tensor([cameras.width, cameras.height]) / focal
    met = (steps > 1) & (meets.abs() <= half).all(-1)
    return steps.where(met, torch.inf).argmin().item() if met.any() else None


def camera_of(page: Any, pixels: int) -> tuple[Cameras, bool]:
    """Return what viser says of a page's camera, and whether it has all of the page's pixels.

    Args:
        page: viser's CameraHandle.
        pixels: the most that the camera may have.
    """
    height, width = max(page.image_height, 1), max(page.image_width, 1)
    focal = height / 2 / math.tan(page.fov / 2)
    cam_to_world = torch.eye(4)
    rotation = Rotation.from_quat(page.wxyz, scalar_first=True).as_matrix()
    cam_to_world[:3, :3] = torch.from_numpy(rotation)
    cam_to_world[:3, 3] = torch.from_numpy(page.position)
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics[None], cam_to_world[None], height, width)
    shrink = math.sqrt(min(1, pixels / (height * width)))
    if shrink == 1:
        return cameras, True
    return cameras.resized(max(round(shrink * height), 1), max(round(shrink * width), 1)), False
