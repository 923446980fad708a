"""Project 3D Gaussians to 2D splats: EWA splatting."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.geometry.motion import rotations
from asysplat.geometry.spherical_harmonics import sh_colors
from asysplat.rendering.interface import MAX_MAGNITUDE, Projections, RenderSettings
from asysplat.scene import Cameras, Gaussians

RADIUS = 3.0  # standard deviations (Kerbl et al. 2023)
BOUNDS_MARGIN = 1e-3  # pixels, more than the rounding error of an extent


@dataclass(frozen=True)
class Splats:
    """M visible pairs (image, Gaussian), sorted by image, then by depth, then by index.

    With the whitening (a, b, c), a pixel at (dx, dy) from the center has
    alpha = opacity * exp(-((a dx + b dy)^2 + (c dy)^2) / 2).
    """

    images: Int[Tensor, "M"]  # index of the image, batch and views flattened
    xy: Float[Tensor, "M 2"]  # center in pixels
    whitening: Float[Tensor, "M 3"]
    opacities: Float[Tensor, "M"]
    colors: Float[Tensor, "M 3"]  # >= 0
    depths: Float[Tensor, "M"]  # z in the camera's frame, in scene units
    first: Int[Tensor, "M 2"]  # first pixel (x, y) that can have alpha >= alpha_min
    last: Int[Tensor, "M 2"]  # last such pixel


class Footprint(NamedTuple):
    """The position and size of a Gaussian in an image."""

    offsets: Tensor  # [..., 3] mean - camera center, world axes
    depths: Tensor  # [...]
    xy: Tensor  # [..., 2]
    whitening: Tensor  # [..., 3]
    deviations: Tensor  # [..., 2] standard deviations along x and y, in pixels
    compensation: Tensor  # [...] of the opacity, for antialiasing


def project(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    centers: Float[Tensor, "B V N 2"] | None = None,
) -> Splats:
    """Project Gaussians [B, N] to views [B, V] of zero skew; image b * V + v is view v of scene b.

    `centers` receives the gradients of the centers. Culled, with gradient 0: depth <= near, opacity
    < alpha_min, no pixel center within the extent, and Gaussians that do not project to finite
    numbers (NaN, infinity, a zero quaternion).
    """
    size = (cameras.width, cameras.height)
    images, indices = select_visible(gaussians, cameras, settings)
    # Only visible pairs enter the graph: culled ones cannot send a NaN back.
    fields = (gaussians.means, gaussians.quats, gaussians.scales)
    footprint = project_footprints(
        *(field.flatten(0, 1).index_select(0, indices) for field in fields),
        cameras.cam_to_world.flatten(0, 1).index_select(0, images),
        cameras.intrinsics.flatten(0, 1).index_select(0, images),
        size,
        settings,
    )
    opacities = gaussians.opacities.flatten().index_select(0, indices) * footprint.compensation
    first, last = _pixel_range(footprint, opacities, size, settings)
    sh = gaussians.sh.flatten(0, 1).index_select(0, indices)
    xy = footprint.xy
    if centers is not None:
        scene, view = images // cameras.num_views, images % cameras.num_views
        xy = xy + (centers - centers.detach())[scene, view, indices % gaussians.num_gaussians]
    return Splats(
        images=images,
        xy=xy,
        whitening=footprint.whitening,
        opacities=opacities,
        colors=sh_colors(sh, footprint.offsets),
        depths=footprint.depths,
        first=first.long(),
        last=last.long(),
    )


@torch.no_grad()
def select_visible(
    gaussians: Gaussians, cameras: Cameras, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Return image and flat Gaussian index of every visible pair, in the order of `Splats`."""
    footprint, visible = _project_all(gaussians, cameras, settings)
    visible = visible.flatten(0, 1)
    depths = footprint.depths.flatten(0, 1).where(visible, torch.inf)
    order = torch.argsort(depths, dim=-1, stable=True)
    images, ranks = torch.nonzero(
        torch.arange(depths.shape[1], device=depths.device) < visible.sum(-1, keepdim=True),
        as_tuple=True,
    )
    scenes = images // cameras.num_views
    return images, order[images, ranks] + scenes * gaussians.num_gaussians


@torch.no_grad()
def project_centers(
    gaussians: Gaussians, cameras: Cameras, settings: RenderSettings
) -> Projections:
    """Project Gaussians [B, N] to views [B, V], without gradients; 0 where one is culled."""
    footprint, visible = _project_all(gaussians, cameras, settings)
    a, b, c = footprint.whitening.unbind(-1)
    trace, root = a * a + b * b + c * c, a * c
    # The larger eigenvalue of the inverse covariance; the smaller is root^2 over it.
    half = trace / 2
    largest = half + ((half - root) * (half + root)).clamp_min(0).sqrt()
    radii = RADIUS * largest.sqrt() / root
    conics = torch.stack((a * a, a * b, b * b + c * c), -1)
    return Projections(
        means2d=footprint.xy.where(visible[..., None], 0),
        conics=conics.where(visible[..., None], 0),
        radii=radii.where(visible, 0),
    )


def _project_all(
    gaussians: Gaussians, cameras: Cameras, settings: RenderSettings
) -> tuple[Footprint, Bool[Tensor, "B V N"]]:
    """Project every Gaussian to every view, and return which of them are visible."""
    size = (cameras.width, cameras.height)
    footprint = project_footprints(
        gaussians.means[:, None],
        gaussians.quats[:, None],
        gaussians.scales[:, None],
        cameras.cam_to_world[:, :, None],
        cameras.intrinsics[:, :, None],
        size,
        settings,
    )
    opacities = gaussians.opacities[:, None] * footprint.compensation
    first, last = _pixel_range(footprint, opacities, size, settings)
    # Comparisons with NaN are false.
    visible = (
        (footprint.depths > settings.limits.near)
        & (footprint.depths < MAX_MAGNITUDE)
        & (opacities >= settings.limits.alpha_min)
        & (gaussians.opacities[:, None] <= 1)
        & (first <= last).all(-1)
        & footprint.whitening.isfinite().all(-1)
        & (footprint.whitening[..., 0] > 0)
        & (gaussians.sh.abs() < MAX_MAGNITUDE).flatten(2).all(-1)[:, None]
    )
    return footprint, visible


def project_footprints(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    cam_to_world: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    settings: RenderSettings,
) -> Footprint:
    """Project Gaussians; all arguments broadcast over their leading dimensions."""
    rotation = cam_to_world[..., :3, :3]
    # The offset comes first: it is exact for scenes far from the origin.
    offsets = means - cam_to_world[..., :3, 3]
    x, y, z = (offsets[..., None, :] @ rotation).squeeze(-2).unbind(-1)
    tangents = torch.stack((x / z, y / z), -1)
    focal = torch.stack((intrinsics[..., 0, 0], intrinsics[..., 1, 1]), -1)
    principal = intrinsics[..., :2, 2]

    sides = focal.new_tensor(size)
    margin = settings.limits.frustum_margin * sides
    clamped = torch.clamp(
        tangents, (-principal - margin) / focal, (sides - principal + margin) / focal
    )
    # Rows of J R^T, in world axes.
    jacobian = (focal / z[..., None])[..., None] * (
        rotation.mT[..., :2, :] - clamped[..., None] * rotation.mT[..., 2:, :]
    )
    rows = jacobian @ rotations(quats) * scales[..., None, :]
    ellipse = whiten(*rows.unbind(-2), settings)
    return Footprint(offsets, z, tangents * focal + principal, *ellipse)


@torch.no_grad()
def _pixel_range(
    footprint: Footprint, opacities: Tensor, size: tuple[int, int], settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Compute the first and last pixel (x, y) whose center is in the box of alpha >= alpha_min."""
    distance = (2 * (opacities / settings.limits.alpha_min).log().clamp_min(0)).sqrt()
    extent = footprint.deviations * distance[..., None] + BOUNDS_MARGIN
    sides = extent.new_tensor(size)
    zero = torch.zeros_like(sides)
    first = (footprint.xy - extent - 0.5).ceil().clamp(zero, sides)
    last = (footprint.xy + extent - 0.5).floor().clamp(zero - 1, sides - 1)
    return first, last


def whiten(row_x: Tensor, row_y: Tensor, settings: RenderSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Factorize the covariance M M^T + eps I, M = (row_x; row_y).

    Return the whitening (a, b, c), which is the Cholesky factor of the inverse; the standard
    deviations along x and y; the factor of the opacity for antialiasing. The determinant is a sum
    of squares (Cauchy-Binet), which cancels to zero for no needle; it is divided by Syy early, so
    that no large scale overflows.
    """
    eps = settings.limits.eps2d
    xx, xy, yy = ((p * q).sum(-1) for p, q in ((row_x, row_x), (row_x, row_y), (row_y, row_y)))
    var_y = yy + eps
    deviation_y = var_y.sqrt()
    minors = torch.linalg.cross(row_x, row_y / deviation_y[..., None]).square().sum(-1)
    det = minors + eps * (1 + xx / var_y)  # over Syy
    a = det.rsqrt()
    whitening = torch.stack((a, -a * xy / var_y, 1 / deviation_y), -1)
    deviations = torch.stack(((xx + eps).sqrt(), deviation_y), -1)
    if not settings.antialiased:
        return whitening, deviations, torch.ones_like(a)
    # sqrt(det(M M^T) / det(M M^T + eps I)), Yu et al. 2024, Eq. 10.
    ratio = (minors / det).clamp_min(settings.limits.compensation_min)
    return whitening, deviations, ratio.sqrt()
