"""Code that both fast backends share: camera rows, constants, formulas and steps around kernels.

The formulas work on vectors of three numbers, as tuples. Numba and Triton compile the same source;
`cuda.math` replaces `sqrt`, `clamp` and `select` by Triton's.
"""

import inspect
import math
from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.rendering.interface import BlendingLimits, RenderOutputs, RenderSettings
from asysplat.scene import Cameras, Gaussians

# Columns of a camera row: axes and center in the world; intrinsics in pixels; limits of x / z and
# y / z for the Jacobian. Only the first 16 columns have a gradient.
RIGHT, DOWN, FORWARD, CENTER, FX, FY, CX, CY = 0, 3, 6, 9, 12, 13, 14, 15
LOW_X, HIGH_X, LOW_Y, HIGH_Y = range(16, 20)
CAMERA, CAMERA_GRADIENT = 20, 16

WHITEN_TO_LOG2 = math.sqrt(0.5 / math.log(2))  # exp(-x^2 / 2) = 2^-(WHITEN_TO_LOG2 x)^2

# Margins of culling: rounding never removes a splat from a pixel that shows it.
EXPONENT_MARGIN = 1e-3  # margin of log2 alpha
PIXEL_MARGIN = 1e-3

# Pixels. A center farther from the image's corner is stored as an offset from this position.
MAX_CENTER_OFFSET = 2.0**30


class KernelInputs(NamedTuple):
    """Arrays or tensors of Gaussians and cameras, or their gradients."""

    means: Any  # [B * N, 3]
    quats: Any  # [B * N, 4]
    scales: Any  # [B * N, 3]
    opacities: Any  # [B * N]
    sh: Any  # [B * N, K, 3]
    cameras: Any  # [B * V, 20], see `camera_rows`


def apply_passes(
    passes: type[torch.autograd.Function],
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Bool[Tensor, "B V H W"] | None,
    centers: Float[Tensor, "B V N 2"] | None,
) -> RenderOutputs:
    """Run a backend's passes as one operation of torch; `centers` receives gradients alone."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    poses = (cameras.cam_to_world, cameras.intrinsics)
    size = (cameras.height, cameras.width)
    masks = masks if settings.culling.masks else None
    *images, origins, stats = passes.apply(settings, size, masks, centers, *fields, *poses)
    return RenderOutputs(*images, stats, origins)


def image_gradients(
    grad_image: Tensor | None,
    grad_alpha: Tensor | None,
    grad_transmittance: Tensor | None,
    transmittance: Float[Tensor, "I H W"],
) -> tuple[Float[Tensor, "I 3 H W"], Float[Tensor, "I H W"]]:
    """Compute the gradients of image and transmittance; alpha is 1 - transmittance."""
    if grad_image is None:
        grad_image = torch.zeros_like(transmittance)[:, None].repeat(1, 3, 1, 1)
    if grad_transmittance is None:
        grad_transmittance = torch.zeros_like(transmittance)
    if grad_alpha is not None:
        grad_transmittance = grad_transmittance - grad_alpha
    return grad_image.contiguous(), grad_transmittance.contiguous()


def active_tiles(masks: Bool[Tensor, "B V H W"], tile: int) -> Bool[Tensor, "tiles"]:
    """Compute which tiles of all images have a pixel that counts."""
    counts = masks.flatten(0, 1).to(torch.float32)
    return torch.nn.functional.max_pool2d(counts, tile, ceil_mode=True).flatten() > 0


def camera_rows(
    cam_to_world: Float[Tensor, "B V 4 4"],
    intrinsics: Float[Tensor, "B V 3 3"],
    size: tuple[int, int],
    limits: BlendingLimits,
) -> Float[Tensor, "I 20"]:
    """Pack each camera into a row of float64; `size` is height and width in pixels."""
    poses = cam_to_world.detach().double().flatten(0, 1)
    pinhole = intrinsics.detach().double().flatten(0, 1)
    focal, principal = pinhole.diagonal(dim1=1, dim2=2)[:, :2], pinhole[:, :2, 2]
    pixels = focal.new_tensor(size[::-1])
    margin = limits.frustum_margin * pixels
    low, high = (-principal - margin) / focal, (pixels - principal + margin) / focal
    bounds = torch.stack((low, high), -1).flatten(1)
    return torch.cat((poses[:, :3].mT.flatten(1), focal, principal, bounds), 1)


def camera_gradients(
    grads: Float[Tensor, "I 16"], cam_to_world: Tensor, intrinsics: Tensor
) -> tuple[Tensor, Tensor]:
    """Convert the gradients of camera rows to gradients of poses and intrinsics."""
    poses, pinhole = (
        torch.zeros(t.shape, dtype=torch.float64, device=t.device)
        for t in (cam_to_world, intrinsics)
    )
    poses.flatten(0, 1)[:, :3] = grads[:, :12].unflatten(1, (4, 3)).mT
    pinhole.flatten(0, 1)[:, [0, 1, 0, 1], [0, 1, 2, 2]] = grads[:, 12:]
    return poses.to(cam_to_world.dtype), pinhole.to(intrinsics.dtype)


def bind(formula: Callable, names: dict[str, object]) -> Callable:
    """Return a formula without a type checker's wrapper, with `names` as its globals."""
    bare = inspect.unwrap(formula)
    return FunctionType(bare.__code__, names)


sqrt = math.sqrt


def clamp(value, low, high):
    """Limit `value` to [low, high]; NaN stays."""
    return low if value < low else high if value > high else value


def select(condition, yes, no):
    """Return `yes` if the condition holds, else `no`."""
    return yes if condition else no


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
    """Multiply element by element."""
    return (p[0] * q[0], p[1] * q[1], p[2] * q[2])


def project_mean(mean, axes, center, focal, limits):
    """Project a mean and linearize the projection around it.

    axes are right, down and forward of the camera; limits (low, high) of x / z, and of y / z.
    Return the offset from the camera's center in world axes; z and 1 / z; the tangents (x / z, y /
    z); the clamped tangents, where the Jacobian is taken; the Jacobian's rows in world axes.
    """
    # The offset comes first: it is exact for scenes far from the origin.
    offset = plus(mean, -1.0, center)
    z = dot(axes[2], offset)
    inverse_z = 1 / z
    tangent_x, tangent_y = dot(axes[0], offset) * inverse_z, dot(axes[1], offset) * inverse_z
    clamped_x = clamp(tangent_x, limits[0][0], limits[0][1])
    clamped_y = clamp(tangent_y, limits[1][0], limits[1][1])
    row_x = scaled(focal[0] * inverse_z, plus(axes[0], -clamped_x, axes[2]))
    row_y = scaled(focal[1] * inverse_z, plus(axes[1], -clamped_y, axes[2]))
    return offset, z, inverse_z, (tangent_x, tangent_y), (clamped_x, clamped_y), row_x, row_y


def project_mean_gradient(g_xyz, g_rows, rows, projected, axes, focal):
    """Compute the gradients of the offset, the axes, fx and fy, cx and cy.

    g_xyz are gradients of the center in pixels and of the depth; rows the Jacobian's rows;
    projected is offset, 1 / z, tangents and clamped tangents.
    """
    g_x, g_y, g_z = g_xyz
    g_row_x, g_row_y = g_rows
    row_x, row_y = rows
    offset, inverse_z, tangents, clamped = projected
    fx, fy = focal
    g_z -= inverse_z * (dot(row_x, g_row_x) + dot(row_y, g_row_y))
    g_fx = g_x * tangents[0] + dot(row_x, g_row_x) / fx
    g_fy = g_y * tangents[1] + dot(row_y, g_row_y) / fy
    g_clamped_x = -fx * inverse_z * dot(axes[2], g_row_x)
    g_clamped_y = -fy * inverse_z * dot(axes[2], g_row_y)
    # A clamped tangent is the limit, (constant - cx) / fx.
    g_tangent_x = g_x * fx + select(clamped[0] == tangents[0], g_clamped_x, 0.0)
    g_tangent_y = g_y * fy + select(clamped[1] == tangents[1], g_clamped_y, 0.0)
    g_limit_x = select(clamped[0] == tangents[0], 0.0, g_clamped_x)
    g_limit_y = select(clamped[1] == tangents[1], 0.0, g_clamped_y)
    g_focal = (g_fx - g_limit_x * clamped[0] / fx, g_fy - g_limit_y * clamped[1] / fy)
    g_principal = (g_x - g_limit_x / fx, g_y - g_limit_y / fy)
    g_z -= inverse_z * (g_tangent_x * tangents[0] + g_tangent_y * tangents[1])
    g_u, g_v = g_tangent_x * inverse_z, g_tangent_y * inverse_z
    g_offset = plus(plus(scaled(g_u, axes[0]), g_v, axes[1]), g_z, axes[2])
    g_right = plus(scaled(g_u, offset), fx * inverse_z, g_row_x)
    g_down = plus(scaled(g_v, offset), fy * inverse_z, g_row_y)
    g_forward = plus(scaled(g_z, offset), -fx * inverse_z * clamped[0], g_row_x)
    g_forward = plus(g_forward, -fy * inverse_z * clamped[1], g_row_y)
    return g_offset, (g_right, g_down, g_forward), g_focal, g_principal


def ellipse_rows(quat, scale, row_x, row_y):
    """Compute the rows of M, where M M^T is the covariance in pixels, scaled and before scaling."""
    axis0, axis1, axis2 = rotation_columns(quat[0], quat[1], quat[2], quat[3])
    rotated_x = (dot(row_x, axis0), dot(row_x, axis1), dot(row_x, axis2))
    rotated_y = (dot(row_y, axis0), dot(row_y, axis1), dot(row_y, axis2))
    return times(rotated_x, scale), times(rotated_y, scale), rotated_x, rotated_y


def covariance(mx, my, eps):
    """Compute xx, xy, yy of M M^T; M's minors; the determinants of M M^T and of M M^T + eps I.

    The determinant is the sum of the squared minors (Cauchy-Binet), which cancels for no needle.
    """
    xx, xy, yy = dot(mx, mx), dot(mx, my), dot(my, my)
    minors = cross(mx, my)
    det0 = dot(minors, minors)
    return xx, xy, yy, minors, det0, det0 + eps * (xx + yy) + eps * eps


def whitening(xy, var_y, det):
    """Compute a, b, c of the exponent ((a dx + b dy)^2 + (c dy)^2) / 2."""
    a = sqrt(var_y / det)
    return a, -a * xy / var_y, 1 / sqrt(var_y)


def covariance_gradient(g_abc, g_det0, g_det, abc, mx, my, eps):
    """Compute the gradients of M's rows from those of `whitening` and both determinants."""
    _, _, yy, minors, _, det = covariance(mx, my, eps)
    var_y = yy + eps
    g_var_y = (g_abc[0] * abc[0] - g_abc[1] * abc[1] - g_abc[2] * abc[2]) / (2 * var_y)
    g_xy = -g_abc[1] * abc[0] / var_y
    g_det -= (g_abc[0] * abc[0] + g_abc[1] * abc[1]) / (2 * det)
    g_minors = g_det0 + g_det
    g_xx, g_yy = eps * g_det, g_var_y + eps * g_det
    g_mx = plus(plus(scaled(2 * g_xx, mx), g_xy, my), 2 * g_minors, cross(my, minors))
    g_my = plus(plus(scaled(2 * g_yy, my), g_xy, mx), 2 * g_minors, cross(minors, mx))
    return g_mx, g_my


def ellipse_rows_gradient(g_mx, g_my, quat, scale, row_x, row_y):
    """Compute the gradients of scale, quaternion and the Jacobian's rows from those of M's rows.

    `quat` is the unit quaternion and 1 / the length of the quaternion it comes from.
    """
    qw, qx, qy, qz, inverse = quat
    _, _, rotated_x, rotated_y = ellipse_rows(quat, scale, row_x, row_y)
    g_scale = plus(times(g_mx, rotated_x), 1.0, times(g_my, rotated_y))
    h_x, h_y = times(g_mx, scale), times(g_my, scale)
    axis0, axis1, axis2 = rotation_columns(qw, qx, qy, qz)
    g_quat = rotation_gradient(
        quat,
        inverse,
        plus(scaled(h_x[0], row_x), h_y[0], row_y),
        plus(scaled(h_x[1], row_x), h_y[1], row_y),
        plus(scaled(h_x[2], row_x), h_y[2], row_y),
    )
    g_row_x = plus(plus(scaled(h_x[0], axis0), h_x[1], axis1), h_x[2], axis2)
    g_row_y = plus(plus(scaled(h_y[0], axis0), h_y[1], axis1), h_y[2], axis2)
    return g_scale, g_quat, g_row_x, g_row_y


def rotation_columns(w, x, y, z):
    """Compute the columns of a unit quaternion's rotation matrix."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def rotation_gradient(quat, inverse, g0, g1, g2):
    """Compute the gradient of a quaternion of length 1 / inverse.

    quat starts with its unit quaternion; g0, g1, g2 are the gradients of its `rotation_columns`.
    """
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
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
