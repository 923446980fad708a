"""The depth term of the loss (paper, Suppl. A), in two variants.

The paper's "predicted disparity" is either rendered at the target views, or computed from the
Gaussians in the input views they are aligned with. The reference is the disparity of a monocular
network if the data has it (`asysplat prepare --disparities`), else the inverse of the depths.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import Gaussians, Views, inverse_depths
from asysplat.training.parallel import Batch, Prediction

MIN_ALPHA = 0.5  # pixels with less alpha are ignored
MIN_DEVIATION = 0.1  # of the median disparity
MIN_DEPTH = 1e-2  # depths are clamped to it, as in Long-LRM
NO_DISPARITIES = (
    "the data has neither disparities nor depths; asysplat prepare --disparities estimates "
    "disparities"
)
NO_DEPTHS = (
    "the data has no depths; training/depth=rendered takes disparities, which "
    "asysplat prepare --disparities estimates"
)


class RenderedDisparity:
    """The paper's formula: compares the depth rendered at the targets with their disparities.

    Both maps are downsampled by `stride`; None: by p_c / p_f of the model, as in the paper.
    """

    renders_depth = True
    missing = NO_DISPARITIES

    def __init__(self, stride: int | None = None):
        self.stride = stride

    def __call__(self, prediction: Prediction, batch: Batch) -> Float[Tensor, ""] | None:
        """Compute the term; None if the targets have neither disparities nor depths."""
        rendering, target = prediction.rendering, reference_disparities(batch["targets"])
        if target is None:
            return None
        stride = self.stride or pixels_apart(prediction.gaussians, batch["inputs"])
        depth, alpha, target = (
            maps[..., ::stride, ::stride] for maps in (rendering.depth, rendering.alpha, target)
        )
        return disparity_distance(depth, target, (target > 0) & (alpha > MIN_ALPHA) & (depth > 0))


class InputDisparity:
    """Compares the depths of Gaussians in their own input views with the views' disparities.

    As in Long-LRM's public code (model/llrm.py). It also fits the paper's sentence "the scene
    geometry is modeled by pixel-aligned prediction".
    """

    renders_depth = False
    missing = NO_DISPARITIES

    def __call__(self, prediction: Prediction, batch: Batch) -> Float[Tensor, ""] | None:
        """Compute the term; None if the inputs have neither disparities nor depths."""
        inputs, target = batch["inputs"], reference_disparities(batch["inputs"])
        if target is None:
            return None
        return disparity_distance(*depths_and_targets(prediction.gaussians, inputs, target))


class LogDepth:
    """Compares the logarithms of Gaussians' depths in their own input views with the views' depths.

    Ours: it sees the scale of a scene, which normalized disparities do not.
    """

    renders_depth = False
    missing = NO_DEPTHS

    def __call__(self, prediction: Prediction, batch: Batch) -> Float[Tensor, ""] | None:
        """Compute the mean over scenes of the mean absolute difference; None without depths."""
        inputs = batch["inputs"]
        if inputs.depths is None:
            return None
        depth, target, valid = depths_and_targets(prediction.gaussians, inputs, inputs.depths)
        error = (depth.log() - torch.where(valid, target, 1).log()).abs() * valid
        return (error.sum((-3, -2, -1)) / valid.sum((-3, -2, -1)).clamp_min(1)).mean()


def reference_disparities(views: Views) -> Float[Tensor, "*batch V H W"] | None:
    """Return the views' disparities, or the inverse of their depths; 0 if unknown."""
    if views.disparities is not None or views.depths is None:
        return views.disparities
    return inverse_depths(views.depths)


def pixels_apart(gaussians: Gaussians, inputs: Views) -> int:
    """Return the distance of neighboring Gaussians in the input views, p_c / p_f, in pixels."""
    pixels = inputs.num_views * inputs.cameras.height * inputs.cameras.width
    return max(1, math.isqrt(pixels // gaussians.num_gaussians))


def own_depths(gaussians: Gaussians, inputs: Views) -> Float[Tensor, "*batch V h w"]:
    """Compute each Gaussian's depth in the input view it is aligned with."""
    cameras, count = inputs.cameras, gaussians.num_gaussians
    stride = pixels_apart(gaussians, inputs)
    height, width = cameras.height // stride, cameras.width // stride
    if count != inputs.num_views * height * width:
        raise InputError(
            f"training/depth=inputs needs a map of Gaussians for each input view, but the model "
            f"gave {count} for {inputs.num_views} views of {cameras.height}x{cameras.width}: "
            "take training/depth=rendered."
        )
    means = gaussians.means.unflatten(-2, (inputs.num_views, height, width))
    offsets = means - cameras.centers[..., None, None, :]
    # A matrix product would be rounded to half precision by autocast.
    return (offsets * cameras.cam_to_world[..., None, None, :3, 2]).sum(-1)


def depths_and_targets(
    gaussians: Gaussians, inputs: Views, target: Float[Tensor, "*batch V H W"]
) -> tuple[
    Float[Tensor, "*batch V h w"], Float[Tensor, "*batch V h w"], Bool[Tensor, "*batch V h w"]
]:
    """Compute `own_depths`, the target at their pixels, and where it is known and counts."""
    depth = own_depths(gaussians, inputs).clamp_min(MIN_DEPTH)
    stride = inputs.cameras.height // depth.shape[-2]
    target = target[..., ::stride, ::stride]
    valid = target > 0
    if inputs.masks is not None:
        valid = valid & inputs.masks[..., ::stride, ::stride]
    return depth, target, valid


def disparity_distance(
    depth: Float[Tensor, "*batch V H W"],
    target: Float[Tensor, "*batch V H W"],
    valid: Bool[Tensor, "*batch V H W"],
) -> Float[Tensor, ""]:
    """Compute the mean over scenes of the mean SmoothL1 of normalized disparities, where valid."""
    predicted, expected = (
        normalized_disparity(maps.flatten(0, -3), valid.flatten(0, -3)).view_as(maps)
        for maps in (1 / torch.where(valid, depth, 1), target)
    )
    error = F.smooth_l1_loss(predicted, expected, reduction="none") * valid
    return (error.sum((-3, -2, -1)) / valid.sum((-3, -2, -1)).clamp_min(1)).mean()


def normalized_disparity(
    disparity: Float[Tensor, "V H W"], valid: Bool[Tensor, "V H W"]
) -> Float[Tensor, "V H W"]:
    """Compute (disparity - median) / mean absolute deviation of each view; invalid pixels are 0.

    The deviation is at least MIN_DEVIATION of the median: depths of an untrained network are nearly
    the same, and a division by almost nothing would make their gradients the largest of all.
    """
    values = torch.where(valid, disparity, torch.nan).flatten(1)
    median = values.nanmedian(dim=1, keepdim=True).values
    centered = torch.where(valid.flatten(1), values - median.nan_to_num(), 0)
    count = valid.flatten(1).sum(1, keepdim=True).clamp_min(1)
    deviation = centered.abs().sum(1, keepdim=True) / count
    floor = (MIN_DEVIATION * median.nan_to_num().abs()).clamp_min(1e-6)
    return (centered / deviation.maximum(floor)).view_as(disparity)
