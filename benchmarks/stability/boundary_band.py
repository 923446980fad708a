"""Pixels where rounding may flip a decision: an alpha or a transmittance is near a cut-off."""

import torch
from torch import Tensor

from asysplat.rendering.interface import RenderSettings
from asysplat.rendering.reference.project import project
from asysplat.scene import Cameras, Gaussians

ALPHA_ROUNDING = 1e-5  # relative; ten times the error of float32
# The transmittance accumulates the rounding of 1 - alpha, up to 100 times that of alpha.
TRANSMITTANCE_ROUNDING = 1e-3
ROWS = 8  # rows of pixels computed at a time, to limit memory


@torch.no_grad()
def boundary_band(gaussians: Gaussians, cameras: Cameras, settings: RenderSettings) -> Tensor:
    """Compute the mask [V, H, W] of pixels where rounding may flip a decision, in float64.

    At these pixels some alpha is within rounding of alpha_min or alpha_max, or some transmittance
    is within rounding of transmittance_min or, for the median depth, of 0.5.
    """
    limits = settings.limits
    scene = gaussians.map(lambda t: t[None].double())
    splats = project(scene, cameras.map(lambda t: t[None].double()), settings)
    band = torch.zeros(cameras.num_views, cameras.height, cameras.width, dtype=torch.bool)
    for view in range(cameras.num_views):
        in_view = splats.images == view
        xy, (a, b, c) = splats.xy[in_view], splats.whitening[in_view].unbind(-1)
        dx = torch.arange(cameras.width) + 0.5 - xy[:, :1]
        for top in range(0, cameras.height, ROWS):
            rows = torch.arange(top, min(top + ROWS, cameras.height))
            dy = (rows + 0.5 - xy[:, 1:])[..., None]  # [M, rows, 1]
            u = a[:, None, None] * dx[:, None] + b[:, None, None] * dy
            alpha = (u.square() + (c[:, None, None] * dy).square()).mul_(-0.5).exp_()
            alpha *= splats.opacities[in_view, None, None]

            def is_near(value, limit, rounding):
                return (value / limit - 1).abs_() < rounding

            near_cutoff = is_near(alpha, limits.alpha_min, ALPHA_ROUNDING)
            near_cutoff |= is_near(alpha, limits.alpha_max, ALPHA_ROUNDING)
            alpha.clamp_max_(limits.alpha_max).mul_(alpha >= limits.alpha_min)
            transmittance = (1 - alpha).cumprod(0)
            near_cutoff |= is_near(transmittance, limits.transmittance_min, TRANSMITTANCE_ROUNDING)
            if settings.depth == "median":
                near_cutoff |= is_near(transmittance, 0.5, ALPHA_ROUNDING)
            # Splats behind the one at which a pixel stops are invisible
            before = torch.cat((torch.ones_like(transmittance[:1]), transmittance[:-1]))
            reached = before > limits.transmittance_min * (1 - TRANSMITTANCE_ROUNDING)
            band[view, rows] = (near_cutoff & reached).any(0)
    return band
