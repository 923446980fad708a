"""One network stage: tokens to its width, then its layer mix (paper, Eq. 1 and Table 6b)."""

import re
from collections.abc import Callable, Collection, Mapping

from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.layers import Layers
from asysplat.models.shapes import StageShape

Component = Callable[..., nn.Module]


class Stage(nn.Module):
    """A network stage: project the tokens to d_s, then apply the layer mix.

    Args:
        previous_width: of the tokens that come in.
        shape: of this stage.
        layers: the layer mix, counts and letters of `blocks`; the same in every stage.
        blocks: letter -> component built from a StageShape, as conf/model/blocks.yaml has them.

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
        self.layers = build_layers(shape, layers, blocks)

    def forward(
        self, tokens: Float[Tensor, "B V h w d"], without: Collection[nn.Module] = ()
    ) -> Float[Tensor, "B V h w e"]:
        return self.layers(self.project(tokens), without)


def to_width(previous_width: int, width: int) -> nn.Module:
    """Build a projection, or nothing where both widths are the same."""
    return nn.Identity() if previous_width == width else nn.Linear(previous_width, width)


def build_layers(shape: StageShape, layers: str, blocks: Mapping[str, Component]) -> Layers:
    """Build the layer mix of a network stage, counts and letters of `blocks`.

    Raises:
        InputError: an unusable layer mix.
    """
    return Layers(*(blocks[letter](shape) for letter in parse_layer_mix(layers, set(blocks))))


def parse_layer_mix(mix: str, letters: set[str]) -> list[str]:
    """Return one letter for each layer: "4m4s" (or "4m+4s") gives m m m m s s s s.

    Args:
        mix: counts and letters.
        letters: the letters that name a block.

    Raises:
        InputError: anything else, or no layer at all.
    """
    terms = re.findall(r"(\d+)([a-z])", mix)
    layers = [letter for count, letter in terms for _ in range(int(count))]
    well_formed = "".join(f"{count}{letter}" for count, letter in terms) == mix.replace("+", "")
    if not well_formed or not layers or not letters.issuperset(layers):
        raise InputError(
            f"model.layers={mix!r}: expected counts and letters of {sorted(letters)}, "
            "such as 4m4s or 7m1t."
        )
    return layers
