"""The depth term in its two readings (paper, Suppl. A): what the paper calls its predicted
disparity is either rendered at the targets or that of the Gaussians in their own input views."""

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import Gaussians, Views
from asysplat.training.outcome import Outcome

STRIDE = 2  # p_c / p_f of the paper: both maps are downsampled by it
SEEN = 0.5  # where Gaussians cover less than this, their depth says nothing
NEAREST = 1e-2  # a smaller depth counts as this, as in Long-LRM


class RenderedDisparity:
    """Of the depth rendered at the target cameras against the targets' depths, as the paper's
    formula has it, a mean over target views."""

    renders_depth = True

    def __call__(self, outcome: Outcome, batch: dict[str, Any]) -> Float[Tensor, ""] | None:
        """The term, or None where the targets have no depths."""
        rendering, targets = outcome.rendering, batch["targets"]
        if targets.depths is None:
            return None
        depth, alpha, target = (
            maps[..., ::STRIDE, ::STRIDE]
            for maps in (rendering.depth, rendering.alpha, targets.depths)
        )
        return disparity_distance(depth, target, (target > 0) & (alpha > SEEN) & (depth > 0))


class InputDisparity:
    """Of each Gaussian's depth in the input view that it is aligned with against that view's depth,
    as Long-LRM's public code has it (model/llrm.py), and the paper where it says that "the scene
    geometry is modeled by pixel-aligned prediction"."""

    renders_depth = False

    def __call__(self, outcome: Outcome, batch: dict[str, Any]) -> Float[Tensor, ""] | None:
        """The term, or None where the inputs have no depths.

        Raises:
            InputError: the Gaussians are no map of the input views.
        """
        inputs = batch["inputs"]
        if inputs.depths is None:
            return None
        depth = own_depths(outcome.gaussians, inputs)
        stride = inputs.cameras.height // depth.shape[-2]
        target = inputs.depths[..., ::stride, ::stride]
        valid = target > 0
        if inputs.masks is not None:
            valid = valid & inputs.masks[..., ::stride, ::stride]
        return disparity_distance(depth.clamp_min(NEAREST), target, valid)


def own_depths(gaussians: Gaussians, inputs: Views) -> Float[Tensor, "*batch V h w"]:
    """Depth along the axis of the input view that each Gaussian is aligned with.

    Raises:
        InputError: the Gaussians are not V h w, with the views' sides over h and w one number.
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
    # Not a matrix product: autocast would round that to half precision.
    return (away * cameras.cam_to_world[..., None, None, :3, 2]).sum(-1)


def disparity_distance(
    depth: Float[Tensor, "*batch V H W"],
    target: Float[Tensor, "*batch V H W"],
    valid: Bool[Tensor, "*batch V H W"],
) -> Float[Tensor, ""]:
    """SmoothL1 between normalised disparities, over the valid pixels."""
    depth, target, valid = (maps.flatten(0, -3) for maps in (depth, target, valid))
    found, expected = (normalised_disparity(maps, valid) for maps in (depth, target))
    error = F.smooth_l1_loss(found, expected, reduction="none")
    return (error * valid).sum() / valid.sum().clamp_min(1)


def normalised_disparity(
    depth: Float[Tensor, "V H W"], valid: Bool[Tensor, "V H W"]
) -> Float[Tensor, "V H W"]:
    """1 / depth, less its median and over its mean absolute deviation, per view; 0 elsewhere."""
    disparity = torch.where(valid, 1 / torch.where(valid, depth, 1), torch.nan).flatten(1)
    median = disparity.nanmedian(dim=1, keepdim=True).values
    centered = torch.where(valid.flatten(1), disparity - median.nan_to_num(), 0)
    count = valid.flatten(1).sum(1, keepdim=True).clamp_min(1)
    deviation = centered.abs().sum(1, keepdim=True) / count
    return (centered / deviation.clamp_min(1e-6)).view_as(depth)
