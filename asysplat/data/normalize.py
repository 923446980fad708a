"""The network's frame: its unit is the farthest input, and points in it have depths."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

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
        depths = None if views.depths is None else views.depths * self.scale
        return replace(views, cameras=cameras, depths=depths)

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
