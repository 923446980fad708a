"""One stage of tokens: to its width, then its layers (paper, Eq. 1)."""

from collections.abc import Callable, Mapping

from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.layer_mix import parse_layer_mix
from asysplat.models.layers import Layers
from asysplat.models.shapes import StageShape

Component = Callable[..., nn.Module]


def stage_layers(shape: StageShape, layers: str, blocks: Mapping[str, Component]) -> Layers:
    """The layer mix of a stage, letters of `blocks`.

    Raises:
        InputError: an unusable layer mix.
    """
    return Layers(*(blocks[letter](shape) for letter in parse_layer_mix(layers, set(blocks))))


def to_width(previous_width: int, width: int) -> nn.Module:
    """A projection where widths differ."""
    return nn.Identity() if previous_width == width else nn.Linear(previous_width, width)


class Stage(nn.Module):
    """Project the tokens to d_s, then apply the layer mix.

    Args:
        previous_width: of the tokens that come in.
        shape: of this stage.
        layers: the layer mix, letters of `blocks`.
        blocks: letter -> component built from a StageShape.

    Raises:
        InputError: an unusable layer mix.
    """

    def __init__(
        self,
        previous_width: int,
        shape: StageShape,
        layers: str,
        blocks: Mapping[str, Component],
    ):
        super().__init__()
        self.project = to_width(previous_width, shape.width)
        self.layers = stage_layers(shape, layers, blocks)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w e"]:
        return self.layers(self.project(tokens))
