"""What is made of images before they are swept: gray and smaller ones, and their edges.

Sums of shifted maps: on a CPU, torch's pooling takes several times as long.
"""

from functools import reduce

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

LUMA = (0.299, 0.587, 0.114)


def gray(images: Float[Tensor, "*more 3 H W"]) -> Float[Tensor, "*more H W"]:
    """Return the luma of RGB images."""
    return (images * images.new_tensor(LUMA)[:, None, None]).sum(-3)


def shrink(
    images: Float[Tensor, "*more H W"], height: int, width: int
) -> Float[Tensor, "*more h w"]:
    """Return images of `height` x `width` pixels, the means over areas of those given."""
    H, W = images.shape[-2:]
    if H % height or W % width:
        smaller = F.interpolate(images.reshape(-1, 1, H, W), (height, width), mode="area")
        return smaller.reshape(*images.shape[:-2], height, width)
    down, right = H // height, W // width
    if down == right == 1:
        return images
    rows = reduce(torch.add, (images[..., k::down, :] for k in range(down)))
    return reduce(torch.add, (rows[..., k::right] for k in range(right))) / (down * right)


def edges(images: Float[Tensor, "B V 3 h w"]) -> Float[Tensor, "B V 2 h w"]:
    """Return the mean absolute color difference to the pixel on the left, and to that above."""
    left = torch.zeros_like(images[:, :, 0])
    above = torch.zeros_like(left)
    left[..., 1:] = images.diff(dim=-1).abs().mean(2)
    above[..., 1:, :] = images.diff(dim=-2).abs().mean(2)
    return torch.stack((left, above), dim=2)
