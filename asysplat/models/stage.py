"""One stage of coarse tokens: to its width, then its layers (paper, Eq. 1)."""

from collections.abc import Callable, Mapping

from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.layer_mix import parse_layer_mix
from asysplat.models.layers import Layers
from asysplat.models.shapes import StageShape

Component = Callable[..., nn.Module]


class Stage(nn.Module):
    """Project the tokens to d_s, or merge and project them, then apply the layer mix.

    Args:
        previous_width: of the tokens that come in.
        shape: of this stage.
        layers: the layer mix, letters of `blocks`.
        blocks: letter -> component built from a StageShape.
        merge: 2 x 2 tokens become one, as in Long-LRM.

    Raises:
        InputError: an unusable layer mix.
    """

    def __init__(
        self,
        previous_width: int,
        shape: StageShape,
        layers: str,
        blocks: Mapping[str, Component],
        merge: bool = False,
    ):
        super().__init__()
        self.merge = TokenMerge(previous_width) if merge else nn.Identity()
        same = previous_width == shape.width
        self.project = nn.Identity() if same else nn.Linear(previous_width, shape.width)
        mix = parse_layer_mix(layers, set(blocks))
        self.layers = Layers(*(blocks[letter](shape) for letter in mix))

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h2 w2 e"]:
        return self.layers(self.project(self.merge(tokens)))


class TokenMerge(nn.Module):
    """2 x 2 neighbouring tokens of a frame become one: a depthwise convolution of stride 2
    (Long-LRM, Ziwen et al. 2025)."""

    def __init__(self, width: int):
        super().__init__()
        self.conv = nn.Conv2d(width, width, kernel_size=2, stride=2, groups=width)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h//2 w//2 d"]:
        maps = rearrange(tokens, "b v h w d -> (b v) d h w")
        return rearrange(self.conv(maps), "(b v) d h w -> b v h w d", b=len(tokens))
