"""What both fast backends share: cameras as rows of numbers, constants, and formulas.

The formulas work on three numbers as a tuple; Numba and Triton compile the same source.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.rendering.interface import Convention

# Columns of a camera's row: its axes and center in the world; intrinsics in pixels; the least and
# the greatest x / z and y / z that the Jacobian is taken at. Only the first 16 have a gradient.
RIGHT, DOWN, FORWARD, CENTER, FX, FY, CX, CY = 0, 3, 6, 9, 12, 13, 14, 15
LOW_X, HIGH_X, LOW_Y, HIGH_Y = range(16, 20)
CAMERA, CAMERA_GRADIENT = 20, 16

WHITEN_TO_LOG2 = math.sqrt(0.5 / math.log(2))  # exp(-x^2 / 2) = 2^-(WHITEN_TO_LOG2 x)^2

# What a skip leaves standing, so that rounding never drops what a pixel would have shown.
EXPONENT_MARGIN = 1e-3  # of log2 alpha
PIXEL_MARGIN = 1e-3

MAX_CENTER_OFFSET = (
    2.0**30
)  # pixels; a center farther outside the image is kept as an offset from here


class Inputs(NamedTuple):
    """Arrays or tensors of Gaussians and cameras, or the gradients of each.

    means [B * N, 3], quats [B * N, 4], scales [B * N, 3], opacities [B * N], sh [B * N, K, 3] of B
    scenes; cameras [B * V, 20], rows from `camera_rows`.
    """

    means: object
    quats: object
    scales: object
    opacities: object
    sh: object
    cameras: object


def camera_rows(
    cam_to_world: Float[Tensor, "B V 4 4"],
    intrinsics: Float[Tensor, "B V 3 3"],
    size: tuple[int, int],
    convention: Convention,
) -> Float[Tensor, "I 20"]:
    """Return a row of float64 for each camera, of images of `size`, height and width in pixels."""
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
    """Return the gradients of poses and intrinsics from those of the cameras' rows."""
    poses, pinhole = (
        torch.zeros(t.shape, dtype=torch.float64, device=t.device)
        for t in (cam_to_world, intrinsics)
    )
    poses.flatten(0, 1)[:, :3] = grads[:, :12].unflatten(1, (4, 3)).mT
    pinhole.flatten(0, 1)[:, [0, 1, 0, 1], [0, 1, 2, 2]] = grads[:, 12:]
    return poses.to(cam_to_world.dtype), pinhole.to(intrinsics.dtype)


def dot(p, q):
    """Compute p . q."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def cross(p, q):
    """Compute p x q."""
    return (
        p[1] * q[2] - p[2] * q[1],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )


def scaled(factor, p):
    """Compute factor p."""
    return (factor * p[0], factor * p[1], factor * p[2])


def plus(p, factor, q):
    """Compute p + factor q."""
    return (p[0] + factor * q[0], p[1] + factor * q[1], p[2] + factor * q[2])


def times(p, q):
    """Multiply number by number."""
    return (p[0] * q[0], p[1] * q[1], p[2] * q[2])


def rotation_columns(w, x, y, z):
    """Return the images of the three axes under a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def rotation_gradient(w, x, y, z, inverse, g0, g1, g2):
    """Return the gradient of a quaternion of length 1 / inverse from those of the columns.

    w, x, y, z is the unit quaternion; g0, g1, g2 are the gradients of its `rotation_columns`.
    """
    gw = 2 * (x * (g1[2] - g2[1]) + y * (g2[0] - g0[2]) + z * (g0[1] - g1[0]))
    gx = 2 * (
        y * (g0[1] + g1[0]) + z * (g0[2] + g2[0]) + w * (g1[2] - g2[1]) - 2 * x * (g1[1] + g2[2])
    )
    gy = 2 * (
        x * (g0[1] + g1[0]) + z * (g1[2] + g2[1]) + w * (g2[0] - g0[2]) - 2 * y * (g0[0] + g2[2])
    )
    gz = 2 * (
        x * (g0[2] + g2[0]) + y * (g1[2] + g2[1]) + w * (g0[1] - g1[0]) - 2 * z * (g0[0] + g1[1])
    )
    radial = w * gw + x * gx + y * gy + z * gz
    return (
        inverse * (gw - radial * w),
        inverse * (gx - radial * x),
        inverse * (gy - radial * y),
        inverse * (gz - radial * z),
    )
