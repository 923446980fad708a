"""The network's frame: its unit is the farthest input, and points in it have depths."""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.data.sequence import Points
from asysplat.geometry.motion import transform
from asysplat.kernels.dispatch import to_float64
from asysplat.scene import Cameras, Gaussians, TensorRecord, Views


@dataclass(frozen=True)
class Normalization(TensorRecord):
    """The transform from the data set's world to the network's frame, and its inverse."""

    world_to_mean: Float[Tensor, "4 4"]  # rigid, float64, to the mean input camera
    scale: float  # factor of all lengths, applied afterwards

    def apply(self, views: Views) -> Views:
        """Transform views, with their depths, from the data set's world to the network's frame."""
        poses = self.world_to_mean @ views.cameras.cam_to_world.double()
        poses[:, :3, 3] *= self.scale
        cameras = replace(views.cameras, cam_to_world=poses.to(views.cameras.cam_to_world))
        depths, point_depths = (
            None if depths is None else depths * self.scale
            for depths in (views.depths, views.point_depths)
        )
        return replace(views, cameras=cameras, depths=depths, point_depths=point_depths)

    def to_network(self, gaussians: Gaussians) -> Gaussians:
        """Transform Gaussians from the data set's world to the network's frame."""
        return transform(gaussians, self.world_to_mean).scale_by(self.scale)

    def to_world(self, gaussians: Gaussians) -> Gaussians:
        """Transform Gaussians from the network's frame to the data set's world."""
        return transform(gaussians.scale_by(1 / self.scale), torch.linalg.inv(self.world_to_mean))

    def cameras_to_world(self, cameras: Cameras) -> Cameras:
        """Transform cameras from the network's frame to the data set's world, in float64."""
        poses = cameras.cam_to_world.double()
        poses[..., :3, 3] /= self.scale
        return replace(cameras, cam_to_world=torch.linalg.inv(self.world_to_mean) @ poses)


def normalize(inputs: Views, targets: Views) -> tuple[Views, Views, Normalization]:
    """Move the world's origin to the mean input camera and scale the farthest input to distance 1.

    The mean pose has the mean of the centers and the mean of the forward and down axes, made
    orthonormal by Gram-Schmidt (as Long-LRM, arXiv 2410.12781). Of inputs in one place the scale
    is 1. One scene, without batch dimension.
    """
    poses = to_float64(inputs.cameras.cam_to_world)
    centers = poses[:, :3, 3]
    mean_pose = torch.eye(4, dtype=poses.dtype, device=poses.device)
    forward, down = poses[:, :3, 2].mean(0), poses[:, :3, 1].mean(0)
    right = torch.linalg.cross(down, forward)
    # On a full circle the forward axes cancel: use the first camera's axes.
    if right.norm() < 1e-3:
        mean_pose[:3, :3] = poses[0, :3, :3]
    else:
        forward, right = forward / forward.norm(), right / right.norm()
        down = torch.linalg.cross(forward, right)
        mean_pose[:3, :3] = torch.stack((right, down, forward), dim=-1)
    mean_pose[:3, 3] = centers.mean(0)
    radius = (centers - centers.mean(0)).norm(dim=-1).max()
    # Smaller differences between the centers are rounding.
    distinct = radius > 1e-6 * centers.abs().max()
    frame = Normalization(torch.linalg.inv(mean_pose), 1 / radius.item() if distinct else 1.0)
    return frame.apply(inputs), frame.apply(targets), frame


POINTS_PER_WINDOW = 4  # on average: enough to include a surface that occludes a point
OCCLUSION_MARGIN = 0.2  # a point so much deeper than its window's nearest point is occluded


def depths_of_points(points: Points, cameras: Cameras) -> Float[Tensor, "V H W"]:
    """Render the depth along z of the nearest point in every pixel; 0 without a visible point.

    A point counts as occluded if it is much deeper than another point in a window around it, since
    sparse points of a surface leave gaps. The sparser the points, the larger the window.
    """
    exact_points, exact = torch.as_tensor(points, dtype=torch.float64), cameras.to(torch.float64)
    inverse = torch.zeros(cameras.num_views, cameras.height, cameras.width)
    for view, nearest in enumerate(inverse):  # every pixel's greatest inverse depth
        (pixels,), (depth,), (inside,) = exact.select([view]).project(exact_points)
        x, y = pixels[inside].long().unbind(-1)
        index, values = y * cameras.width + x, (1 / depth[inside]).float()
        nearest.view(-1).scatter_reduce_(0, index, values, "amax")
    nearest = torch.stack([_window_maximum(view) for view in inverse])
    visible = (inverse > 0) & (inverse * (1 + OCCLUSION_MARGIN) >= nearest)
    return torch.where(visible, 1 / inverse, 0).to(cameras.intrinsics)


def _window_maximum(inverse: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Return the greatest inverse depth in the window of 3 x 3 cells around every pixel's cell."""
    known = (inverse > 0).sum().clamp_min(1).item()
    cell = max(1, round((POINTS_PER_WINDOW * inverse.numel() / known) ** 0.5 / 3))
    cells = F.max_pool2d(inverse[None], cell, ceil_mode=True)
    windows = F.max_pool2d(cells, 3, stride=1, padding=1)[0]
    row, column = (torch.arange(length) // cell for length in inverse.shape)
    return windows[row[:, None], column]
