"""Which photographs are blurred: far less sharp than those that show about the same."""

import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.scene import Cameras

COMPARED = 5  # nearest photographs, itself among them, whose median sharpness counts
BLURRED = 0.6  # share of it below which a photograph is blurred


def find_blurred(images: Float[Tensor, "V 3 H W"], cameras: Cameras) -> Bool[Tensor, "V"]:
    """Find the photographs whose sharpness is far below that of their neighbors.

    Sharpness is the root of the mean square of the Laplacian of the gray image.
    """
    gray = F.pad(images.mean(1, keepdim=True), (1, 1, 1, 1), mode="replicate")
    kernel = gray.new_tensor([[0, 1, 0], [1, -4, 1], [0, 1, 0]])[None, None]
    sharpness = F.conv2d(gray, kernel).square().mean((1, 2, 3)).sqrt()
    apart = cameras.distances(cameras)
    near = apart.topk(min(COMPARED, len(images)), largest=False).indices
    return sharpness < BLURRED * sharpness[near].median(-1).values
