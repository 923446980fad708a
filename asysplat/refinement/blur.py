"""Which photographs are blurred: far less sharp than those that show about the same."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from asysplat.scene import Cameras, decode

COMPARED = 5  # nearest photographs, itself among them, whose median sharpness counts
BLURRED = 0.6  # share of it below which a photograph is blurred


def find_blurred(
    images: Float[Tensor, "V 3 H W"] | UInt8[Tensor, "V 3 H W"], cameras: Cameras
) -> Bool[Tensor, "V"]:
    """Find the photographs whose sharpness is far below that of their neighbors.

    Sharpness is the root of the mean square of the Laplacian of the gray image.
    """
    kernel = cameras.intrinsics.new_tensor([[0, 1, 0], [1, -4, 1], [0, 1, 0]])[None, None]
    sharpness = torch.stack([_sharpness(decode(image), kernel) for image in images])
    apart = cameras.distances(cameras)
    near = apart.topk(min(COMPARED, len(images)), largest=False).indices
    return sharpness < BLURRED * sharpness[near].median(-1).values


def _sharpness(image: Float[Tensor, "3 H W"], kernel: Float[Tensor, "1 1 3 3"]) -> Tensor:
    gray = F.pad(image.mean(0)[None, None], (1, 1, 1, 1), mode="replicate")
    return F.conv2d(gray, kernel).square().mean().sqrt()
