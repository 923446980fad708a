"""Compute image and depth metrics, those of baselines, and means of them."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.files import atomic_write
from asysplat.kernels.dispatch import to_float64, without_autocast
from asysplat.scene import Views

MSE_FLOOR = 1e-10  # PSNR of identical images is 100 dB, not infinity
SSIM_WINDOWS = {"gaussian": 11, "uniform": 7}  # pixels on a side
SSIM_SIGMA = 1.5  # standard deviation of the Gaussian window, in pixels
SSIM_K2 = 0.03
DELTA = 1.25
METRICS = {  # name in results: title in tables
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "absrel": "AbsRel",
    "delta1": f"delta<{DELTA}",
}

Window = Literal["gaussian", "uniform"]
Covariance = Literal["biased", "sample"]
Alignment = Literal["none", "median"]
Images = Float[Tensor, "*batch V 3 H W"]
Depths = Float[Tensor, "*batch V H W"]
Masks = Bool[Tensor, "*batch V H W"]
PerView = Float[Tensor, "*batch V"]


def psnr(rendered: Images, target: Images, masks: Masks | None = None) -> PerView:
    """Compute the PSNR in dB of each image in [0, 1], or of the pixels in masks.

    `rendered` is clamped.
    """
    square = (rendered.float().clamp(0, 1) - target.float()).square().mean(-3)
    if masks is None:
        mse = square.mean((-2, -1))
    else:
        mse = (square * masks).sum((-2, -1)) / masks.sum((-2, -1)).clamp_min(1)
    return -10 * mse.clamp_min(MSE_FLOOR).log10()


def fit_exposure(rendered: Images, target: Images, masks: Masks | None = None) -> Images:
    """Apply to each channel of each image the gain and offset that bring it nearest to its target.

    Only pixels in masks count; a channel without contrast becomes its target's mean.
    """
    x, y = to_float64(rendered), to_float64(target)
    weight = torch.ones_like(x[..., :1, :, :]) if masks is None else masks[..., None, :, :].to(x)
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1)

    def mean(values: Tensor) -> Tensor:
        return (weight * values).sum((-2, -1), keepdim=True) / total

    mean_x, mean_y = mean(x), mean(y)
    variance, covariance = mean((x - mean_x) ** 2), mean((x - mean_x) * (y - mean_y))
    return ((x - mean_x) * (covariance / variance.clamp_min(1e-12)) + mean_y).to(rendered)


def ssim(
    rendered: Images, target: Images, window: Window = "gaussian", covariance: Covariance = "biased"
) -> PerView:
    """Compute the SSIM of each image in [0, 1] (Wang et al. 2004), mean over the channels.

    `rendered` is clamped, the data range is 1, and only windows inside the image count. The
    covariance is the weighted sum of the products of deviations within a window ("biased"), or this
    sum times n / (n - 1) for its n pixels ("sample"), as in scikit-image.
    """
    # Not above: importing torchmetrics takes longer than torch.
    from torchmetrics.functional.image import structural_similarity_index_measure

    height, width = rendered.shape[-2:]
    check_ssim_size(height, width, window)
    size = SSIM_WINDOWS[window]
    # Scaling all variances by n / (n - 1) equals dividing their constant, k2^2, by it.
    k2 = SSIM_K2 if covariance == "biased" else SSIM_K2 * math.sqrt(1 - 1 / size**2)
    with without_autocast(rendered):
        _, similarity = structural_similarity_index_measure(
            rendered.float().clamp(0, 1).flatten(0, -4),
            target.float().flatten(0, -4),
            gaussian_kernel=window == "gaussian",
            sigma=SSIM_SIGMA,
            kernel_size=size,
            reduction="none",
            data_range=1.0,
            k2=k2,
            return_full_image=True,
        )
    # torchmetrics mirrors the image at its border; leave those windows out, like scikit-image.
    border = size // 2
    inside = similarity[..., border : height - border, border : width - border]
    return inside.mean((-3, -2, -1)).reshape(rendered.shape[:-3])


def check_ssim_size(height: int, width: int, window: Window) -> None:
    """Raise InputError if images are smaller than the window."""
    size = SSIM_WINDOWS[window]
    if min(height, width) < size:
        raise InputError(
            f"SSIM needs images of at least {size}x{size} pixels, these have {height}x{width}: "
            "give larger ones (height and width)."
        )


def abs_rel(depth: Depths, target_depth: Depths, alignment: Alignment = "none") -> PerView:
    """Compute the mean of |depth - target| / target over the pixels with target > 0.

    Args:
        depth, target_depth: along the camera's z axis; a target of 0 is unknown.
        alignment: "median" first scales each view's depth so that the (lower) medians agree,
            unless the scale would not be finite.

    Returns:
        NaN for a view without a known depth.
    """
    depth, target, valid = _prepare(depth, target_depth, alignment)
    return _mean_where(valid, (depth - target).abs() / target)


def delta1(depth: Depths, target_depth: Depths, alignment: Alignment = "none") -> PerView:
    """Compute the fraction of known pixels with max(depth / target, target / depth) < 1.25."""
    depth, target, valid = _prepare(depth, target_depth, alignment)
    # Without a division, a depth <= 0 is wrong rather than NaN.
    close = (depth < DELTA * target) & (target < DELTA * depth)
    return _mean_where(valid, close.float())


def _prepare(
    depth: Depths, target: Depths, alignment: Alignment
) -> tuple[Depths, Depths, Bool[Tensor, "*batch V H W"]]:
    depth, target, valid = depth.float(), target.float(), target > 0
    if alignment == "median":
        scale = _median_where(valid, target) / _median_where(valid, depth)
        depth = depth * scale.where(scale.isfinite(), 1)[..., None, None]
    return depth, target, valid


def _median_where(mask: Bool[Tensor, "*batch V H W"], values: Depths) -> PerView:
    return values.where(mask, torch.nan).flatten(-2).nanmedian(-1).values


def _mean_where(mask: Bool[Tensor, "*batch V H W"], values: Depths) -> PerView:
    return values.where(mask, 0).sum((-2, -1)) / mask.sum((-2, -1))


def mean_color_images(inputs: Views, targets: Views) -> Float[Tensor, "*batch Vt 3 H W"]:
    """Fill every target with one color: the mean color of the inputs of its scene."""
    return inputs.mean_color()[..., None, :, None, None].expand_as(targets.images)


def nearest_view_images(inputs: Views, targets: Views) -> Float[Tensor, "*batch Vt 3 H W"]:
    """Copy the nearest input view, see `Cameras.distances`, for every target of the same size."""
    return inputs.nearest_images(targets.cameras)


def constant_depths(inputs: Views, targets: Views) -> Float[Tensor, "*batch Vt H W"]:
    """Fill every target with the depth of the mean inverse depth that the inputs know; else 0."""
    inverse = 1 / inputs.known_depths
    mean = inverse.where(inverse.isfinite(), torch.nan).flatten(-3).nanmean(-1)
    return (1 / mean).nan_to_num()[..., None, None, None].expand_as(targets.depths)


BASELINES = {  # name in results: title in tables, and what draws the targets
    "mean_color": ("mean color", mean_color_images),
    "nearest_view": ("nearest view, copied", nearest_view_images),
}
DEPTH_BASELINES = {  # likewise, their depths
    "mean_inverse_depth": ("mean inverse depth", constant_depths)
}


ImageRow = dict[str, str | float | int]
# Columns that name the image of a row; the others are numbers.
LABELS = ("set", "scene", "images", "view", "method")


def average(rows: Sequence[ImageRow], over: Literal["images", "scenes"]) -> dict[str, float]:
    """Average every numeric column over the images that have it; NaN is left out.

    Over "scenes", the images of each scene are averaged first.
    """
    if over == "scenes":
        scenes: dict[str | float, list[ImageRow]] = {}
        for row in rows:
            scenes.setdefault(row["scene"], []).append(row)
        rows = [average(images, "images") for images in scenes.values()]
    columns: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row.items():
            if name not in LABELS:
                columns.setdefault(name, []).append(value)
    return {name: torch.tensor(values).nanmean().item() for name, values in columns.items()}


def write_csv(path: Path, rows: Sequence[ImageRow]) -> None:
    """Write a CSV file atomically; columns that a row lacks are left empty."""
    with atomic_write(path) as partial, partial.open("w", newline="") as file:
        columns = dict.fromkeys(name for row in rows for name in row)
        writer = csv.DictWriter(file, fieldnames=list(columns))
        writer.writeheader()
        writer.writerows(rows)
