"""Cameras as the kernels read them: a row of numbers each."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.rendering.convention import Convention

# Its axes and centre in the world; intrinsics in pixels; the least and the greatest x / z and y / z
# that the Jacobian is taken at. Its gradient is that of the first 16.
RIGHT, DOWN, FORWARD, CENTER, FX, FY, CX, CY = 0, 3, 6, 9, 12, 13, 14, 15
LOW_X, HIGH_X, LOW_Y, HIGH_Y = range(16, 20)
CAMERA, CAMERA_GRADIENT = 20, 16


def camera_rows(
    cam_to_world: Float[Tensor, "B V 4 4"],
    intrinsics: Float[Tensor, "B V 3 3"],
    size: tuple[int, int],
    convention: Convention,
) -> Float[Tensor, "I 20"]:
    """Float64, of images of `size`, height and width in pixels."""
    poses = cam_to_world.detach().double().flatten(0, 1)
    pinhole = intrinsics.detach().double().flatten(0, 1)
    focal, principal = pinhole[:, [0, 1], [0, 1]], pinhole[:, :2, 2]
    pixels = focal.new_tensor(size[::-1])
    margin = convention.frustum_margin * pixels
    low, high = (-principal - margin) / focal, (pixels - principal + margin) / focal
    limits = torch.stack((low, high), -1).flatten(1)
    return torch.cat((poses[:, :3].mT.flatten(1), focal, principal, limits), 1)


def camera_gradients(
    grads: Float[Tensor, "I 16"], cam_to_world: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of poses and intrinsics from those of their rows."""
    poses, pinhole = (
        torch.zeros(t.shape, dtype=torch.float64, device=t.device)
        for t in (cam_to_world, intrinsics)
    )
    poses.flatten(0, 1)[:, :3] = grads[:, :12].unflatten(1, (4, 3)).mT
    pinhole.flatten(0, 1)[:, [0, 1, 0, 1], [0, 1, 2, 2]] = grads[:, 12:]
    return poses.to(cam_to_world.dtype), pinhole.to(intrinsics.dtype)
