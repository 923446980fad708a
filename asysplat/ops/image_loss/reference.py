"""The image loss by its formula in torch, for any device and float type."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

SIZE = 11  # pixels along a side of a window
SIGMA = 1.5  # standard deviation of a window's Gaussian in pixels
C1, C2 = 0.01**2, 0.03**2  # constants of Wang et al. 2004, for a data range of 1


def window_weights() -> Float[Tensor, "11"]:
    """Return the Gaussian weights along one side of a window, in float64; they sum to 1."""
    offsets = torch.arange(SIZE, dtype=torch.float64) - SIZE // 2
    weights = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    return weights / weights.sum()


def loss_weights(height: int, width: int, ssim_weight: float) -> tuple[float, float]:
    """Return the weights in an image's loss of each pixel's |d| and of each window's 1 - SSIM."""
    windows = (height - SIZE + 1) * (width - SIZE + 1)
    per_window = ssim_weight / (3 * windows) if ssim_weight else 0.0
    return (1 - ssim_weight) / (3 * height * width), per_window


def image_loss_reference(
    rendered: Float[Tensor, "*batch 3 H W"],
    target: Float[Tensor, "*batch 3 H W"],
    ssim_weight: float,
) -> Float[Tensor, "*batch"]:
    """Compute the loss; see `asysplat.ops.image_loss`. SSIM is left out if its weight is 0."""
    loss = (1 - ssim_weight) * (rendered - target).abs().mean((-3, -2, -1))
    if ssim_weight:
        loss = loss + ssim_weight * (1 - _ssim(rendered, target).mean((-3, -2, -1)))
    return loss


def _ssim(x: Float[Tensor, "*batch 3 H W"], y: Float[Tensor, "*batch 3 H W"]) -> Tensor:
    """Compute the SSIM of each window inside the image (Wang et al. 2004)."""
    # All at once, as a GPU waits for launches.
    mean_x, mean_y, xx, yy, xy = _blur(torch.stack((x, y, x * x, y * y, x * y)))
    variance_x, variance_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return luminance * (2 * covariance + C2) / (variance_x + variance_y + C2)


@cache
def _window_on(device: torch.device, dtype: torch.dtype) -> Float[Tensor, "11"]:
    return window_weights().to(device, dtype)


def _blur(image: Float[Tensor, "*batch 3 H W"]) -> Float[Tensor, "*batch 3 h w"]:
    # Not a convolution: cuDNN would round its factors to TF32.
    weights = _window_on(image.device, image.dtype)
    for dim in (-1, -2):
        image = image.unfold(dim, SIZE, 1) @ weights
    return image
