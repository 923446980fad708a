"""Image and depth metrics, one number a view, always in fp32. A metric needs a named protocol."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from asysplat.errors import InputError
from asysplat.ops.precision import without_autocast

MSE_FLOOR = 1e-10  # PSNR of identical images is 100 dB, not infinity
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
DELTA = 1.25

# Pixels that a view's mask excludes are shown as in the photograph before any image metric.
# Written beside the numbers: the same images differ by dB and hundredths between protocols.
PROTOCOL = {
    "psnr": "RGB in [0, 1], rendering clamped, from each image's own MSE (at most 100 dB), "
    "mean over images",
    "ssim": "RGB in [0, 1], rendering clamped, Gaussian window 11x11 sigma 1.5, data range 1, "
    "biased covariance, windows wholly inside the image, mean over images",
    "lpips": "v0.1, RGB in [0, 1] scaled to [-1, 1], rendering clamped, full resolution, "
    "mean over images",
    "absrel": "|d - t| / t, depth not aligned, mean over a view's pixels of known depth, "
    "then over views",
    "delta1": "share of a view's pixels of known depth with max(d/t, t/d) < 1.25, depth not "
    "aligned, mean over views",
}

Images = Float[Tensor, "*batch V 3 H W"]
Depths = Float[Tensor, "*batch V H W"]
PerView = Float[Tensor, "*batch V"]


def psnr(rendered: Images, target: Images) -> PerView:
    """Peak signal-to-noise ratio in dB of each image in [0, 1]; see PROTOCOL."""
    difference = rendered.float().clamp(0, 1) - target.float()
    mse = difference.square().mean((-3, -2, -1))
    return -10 * mse.clamp_min(MSE_FLOOR).log10()


def ssim(rendered: Images, target: Images) -> PerView:
    """Structural similarity of each image in [0, 1] (Wang et al. 2004); see PROTOCOL.

    Raises:
        InputError: an image is smaller than the 11x11 window.
    """
    height, width = rendered.shape[-2:]
    if min(height, width) < SSIM_WINDOW:
        raise InputError(
            f"SSIM needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, these have "
            f"{height}x{width}: raise the resolution."
        )
    with without_autocast(rendered):
        _, similarity = structural_similarity_index_measure(
            rendered.float().clamp(0, 1).flatten(0, -4),
            target.float().flatten(0, -4),
            sigma=SSIM_SIGMA,
            kernel_size=SSIM_WINDOW,
            reduction="none",
            data_range=1.0,
            return_full_image=True,
        )
    # torchmetrics mirrors the image at its border; those windows are left out, as the field does.
    border = SSIM_WINDOW // 2
    inside = similarity[..., border : height - border, border : width - border]
    return inside.mean((-3, -2, -1)).reshape(rendered.shape[:-3])


def abs_rel(
    depth: Depths, target_depth: Depths, alignment: Literal["none", "median"] = "none"
) -> PerView:
    """Mean of |depth - target| / target over the pixels with target > 0.

    Args:
        depth, target_depth: along the camera's z axis; a target of 0 is unknown.
        alignment: "median" first scales each view's depth so that the medians agree
            (of an even number of pixels, the lower of the two middle ones).

    Returns:
        NaN for a view without a known depth.
    """
    depth, target, known = _prepare(depth, target_depth, alignment)
    return _mean_where(known, (depth - target).abs() / target)


def delta1(
    depth: Depths, target_depth: Depths, alignment: Literal["none", "median"] = "none"
) -> PerView:
    """Share of the pixels with target > 0 where max(depth / target, target / depth) < 1.25.

    Arguments and NaN as in `abs_rel`.
    """
    depth, target, known = _prepare(depth, target_depth, alignment)
    # Without a division, a depth <= 0 is simply wrong.
    close = (depth < DELTA * target) & (target < DELTA * depth)
    return _mean_where(known, close.float())


def _prepare(
    depth: Depths, target: Depths, alignment: str
) -> tuple[Depths, Depths, Bool[Tensor, "*batch V H W"]]:
    depth, target, known = depth.float(), target.float(), target > 0
    if alignment == "median":
        scale = _median_where(known, target) / _median_where(known, depth)
        depth = depth * scale[..., None, None]
    return depth, target, known


def _median_where(mask: Bool[Tensor, "*batch V H W"], values: Depths) -> PerView:
    return values.where(mask, torch.nan).flatten(-2).nanmedian(-1).values


def _mean_where(mask: Bool[Tensor, "*batch V H W"], values: Depths) -> PerView:
    return values.where(mask, 0).sum((-2, -1)) / mask.sum((-2, -1))
