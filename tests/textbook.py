"""Alphas of Gaussians by the textbook's formulas, in the float type of the inputs."""

import torch
from torch import Tensor

from asysplat.rendering import INRIA
from asysplat.scene import Cameras, Gaussians


def textbook_alphas(gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Compute alphas [M, H, W] and depths [M] of M scenes of one Gaussian and one camera.

    World to camera by a matrix, the covariance inverted by its determinant xx yy - xy^2, the
    exponent -(A dx^2 + C dy^2) / 2 - B dx dy.
    """
    to_camera = torch.linalg.inv(cameras.cam_to_world[:, 0])
    means = gaussians.means[:, 0]
    homogeneous = torch.cat((means, torch.ones_like(means[:, :1])), -1)
    x, y, z = (to_camera @ homogeneous[..., None]).squeeze(-1)[:, :3].unbind(-1)
    fx, fy = cameras.intrinsics[:, 0, 0, 0], cameras.intrinsics[:, 0, 1, 1]
    cx, cy = cameras.intrinsics[:, 0, 0, 2], cameras.intrinsics[:, 0, 1, 2]
    w, i, j, k = torch.nn.functional.normalize(gaussians.quats[:, 0], dim=-1).unbind(-1)
    rotation = torch.stack(
        (
            *(1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)),
            *(2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)),
            *(2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)),
        ),
        -1,
    ).unflatten(-1, (3, 3))
    spread = rotation * gaussians.scales
    covariance = spread @ spread.mT
    width, height = cameras.width, cameras.height
    margin_x, margin_y = INRIA.frustum_margin * width, INRIA.frustum_margin * height
    tx = torch.clamp(x / z, (-cx - margin_x) / fx, (width - cx + margin_x) / fx)
    ty = torch.clamp(y / z, (-cy - margin_y) / fy, (height - cy + margin_y) / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack((fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z), -1)
    jacobian = jacobian.unflatten(-1, (2, 3)) @ to_camera[:, :3, :3]
    projected = jacobian @ covariance @ jacobian.mT
    xx, xy = projected[:, 0, 0] + INRIA.eps2d, projected[:, 0, 1]
    yy = projected[:, 1, 1] + INRIA.eps2d
    det = xx * yy - xy * xy
    a, b, c = (t[:, None, None] for t in (yy / det, -xy / det, xx / det))
    columns, rows = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    dx = (columns - (fx * x / z + cx)[:, None])[:, None, :]
    dy = (rows - (fy * y / z + cy)[:, None])[:, :, None]
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    alpha = (gaussians.opacities[:, :, None] * power.exp()).clamp(max=INRIA.alpha_max)
    return torch.where((power <= 0) & (alpha >= INRIA.alpha_min), alpha, 0), z
