"""Images and Plücker rays to tokens (paper, Sec. 3.2)."""

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.prior import Prior
from asysplat.scene import Views

PIXEL_CHANNELS = 9


def pixel_features(views: Views, prior: Prior | None) -> Float[Tensor, "B V H W c"]:
    """Return RGB in [-1, 1], ray moment o x d, unit direction d and the prior of every pixel."""
    origins, directions = views.cameras.rays()
    colors = rearrange(views.images, "b v c h w -> b v h w c") * 2 - 1
    features = [colors, torch.linalg.cross(origins, directions), directions]
    if prior is not None:
        features.append(prior.features(views.cameras.height, views.cameras.width))
    return torch.cat(features, dim=-1)


class Tokenizer(nn.Module):
    """Linear embedding of p x p patches, then LayerNorm.

    Args:
        patch: p_c or p_f, in pixels.
        width: d_c or d_f.
        channels: channels of a pixel, PIXEL_CHANNELS plus those of the prior.
        bias: whether the LayerNorm has one.
    """

    def __init__(self, patch: int, width: int, channels: int = PIXEL_CHANNELS, bias: bool = True):
        super().__init__()
        self.patch = patch
        self.embed = nn.Linear(channels * patch**2, width, bias=False)
        self.norm = nn.LayerNorm(width, bias=bias)

    def forward(self, pixels: Float[Tensor, "B V H W c"]) -> Float[Tensor, "B V h w d"]:
        patches = rearrange(
            pixels, "b v (h p) (w q) c -> b v h w (p q c)", p=self.patch, q=self.patch
        )
        return self.norm(self.embed(patches))
