"""The depth term of the loss (paper, Suppl. A), in two readings.

The paper's "predicted disparity" is either rendered at the target views, or that of the Gaussians
in the input views they are aligned with. It is compared with a monocular network's where the data
has that (`python -m asysplat.data.disparity`), else with the inverse of the data's depths.
"""

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import Gaussians, Views
from asysplat.training.outcome import Outcome

STRIDE = 2  # p_c / p_f of the paper, by which both maps are downsampled
MIN_ALPHA = 0.5  # below it, too little of the pixel is covered for its depth to count
MIN_DEPTH = 1e-2  # smaller depths are raised to it, as in Long-LRM


class RenderedDisparity:
    """Compares the depth rendered at the target cameras with the targets' disparities.

    This is the paper's formula, a mean over target views.
    """

    renders_depth = True

    def __call__(self, outcome: Outcome, batch: dict[str, Any]) -> Float[Tensor, ""] | None:
        """Compute the term; None if the targets have neither disparities nor depths."""
        rendering, known = outcome.rendering, known_disparities(batch["targets"])
        if known is None:
            return None
        depth, alpha, target = (
            maps[..., ::STRIDE, ::STRIDE] for maps in (rendering.depth, rendering.alpha, known)
        )
        return disparity_distance(depth, target, (target > 0) & (alpha > MIN_ALPHA) & (depth > 0))


class InputDisparity:
    """Compares Gaussians, in the input views they are aligned with, with those views' disparities.

    This is what Long-LRM's public code does (model/llrm.py). It also fits the paper's sentence
    "the scene geometry is modeled by pixel-aligned prediction".
    """

    renders_depth = False

    def __call__(self, outcome: Outcome, batch: dict[str, Any]) -> Float[Tensor, ""] | None:
        """Compute the term; None if the inputs have neither disparities nor depths.

        Raises:
            InputError: the Gaussians are not a map for each input view, see `own_depths`.
        """
        inputs = batch["inputs"]
        known = known_disparities(inputs)
        if known is None:
            return None
        depth = own_depths(outcome.gaussians, inputs)
        stride = inputs.cameras.height // depth.shape[-2]
        target = known[..., ::stride, ::stride]
        valid = target > 0
        if inputs.masks is not None:
            valid = valid & inputs.masks[..., ::stride, ::stride]
        return disparity_distance(depth.clamp_min(MIN_DEPTH), target, valid)


def known_disparities(views: Views) -> Float[Tensor, "*batch V H W"] | None:
    """Return the views' disparities, else the inverse of their depths; 0 where unknown."""
    if views.disparities is not None or views.depths is None:
        return views.disparities
    known = views.depths > 0
    return torch.where(known, 1 / torch.where(known, views.depths, 1), 0)


def own_depths(gaussians: Gaussians, inputs: Views) -> Float[Tensor, "*batch V h w"]:
    """Compute each Gaussian's depth in the input view it is aligned with.

    Raises:
        InputError: there are not V h w Gaussians, with height / h = width / w a whole number.
    """
    cameras, count = inputs.cameras, gaussians.num_gaussians
    stride = max(1, math.isqrt(inputs.num_views * cameras.height * cameras.width // count))
    height, width = cameras.height // stride, cameras.width // stride
    if count != inputs.num_views * height * width:
        raise InputError(
            f"training/depth=inputs needs a map of Gaussians for each input view, but the model "
            f"gave {count} for {inputs.num_views} views of {cameras.height}x{cameras.width}: "
            "take training/depth=rendered."
        )
    means = gaussians.means.unflatten(-2, (inputs.num_views, height, width))
    away = means - cameras.centers[..., None, None, :]
    # A matrix product would be rounded to half precision by autocast.
    return (away * cameras.cam_to_world[..., None, None, :3, 2]).sum(-1)


def disparity_distance(
    depth: Float[Tensor, "*batch V H W"],
    target: Float[Tensor, "*batch V H W"],
    valid: Bool[Tensor, "*batch V H W"],
) -> Float[Tensor, ""]:
    """Compute the mean over scenes of the mean SmoothL1 between normalized disparities.

    The inner mean is over a scene's valid pixels.

    Args:
        depth: as predicted.
        target: disparities.
        valid: where both are known.
    """
    found, expected = (
        normalized_disparity(maps.flatten(0, -3), valid.flatten(0, -3)).view_as(maps)
        for maps in (1 / torch.where(valid, depth, 1), target)
    )
    error = F.smooth_l1_loss(found, expected, reduction="none") * valid
    of_scene = (-3, -2, -1)
    return (error.sum(of_scene) / valid.sum(of_scene).clamp_min(1)).mean()


def normalized_disparity(
    disparity: Float[Tensor, "V H W"], valid: Bool[Tensor, "V H W"]
) -> Float[Tensor, "V H W"]:
    """Compute the disparity less its median, over its mean absolute deviation; 0 if not valid.

    The median and the deviation are those of each view's valid pixels.
    """
    known = torch.where(valid, disparity, torch.nan).flatten(1)
    median = known.nanmedian(dim=1, keepdim=True).values
    centered = torch.where(valid.flatten(1), known - median.nan_to_num(), 0)
    count = valid.flatten(1).sum(1, keepdim=True).clamp_min(1)
    deviation = centered.abs().sum(1, keepdim=True) / count
    return (centered / deviation.clamp_min(1e-6)).view_as(disparity)
