"""One network stage: tokens to its width, then its layer mix (paper, Eq. 1 and Table 6b)."""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.layers import Layers, StageShape

MAX_LAYERS = 999  # of a stage; a configuration may come from someone else
Component = Callable[..., nn.Module]
Built = TypeVar("Built", bound=nn.Module)


def build_component(component: Callable[..., Built], *arguments: Any, **options: Any) -> Built:
    """Build a component from a random stream of its own, whose seed is the next random number.

    So networks that differ in a component start with the same weights in all others.
    """
    seed = int(torch.randint(2**63 - 1, (), device="cpu"))
    with torch.random.fork_rng(devices=()):
        torch.default_generator.manual_seed(seed)
        return component(*arguments, **options)


class Stage(nn.Module):
    """A network stage: merge or project the tokens to d_s, then apply the layer mix.

    The layers see global tokens and the others as one sequence.

    Args:
        layers: the layer mix, counts and letters of `blocks`.
        blocks: letter -> component built from a StageShape, as in conf/model/blocks.yaml.
        merge: whether 2 x 2 tokens become one.
    """

    def __init__(
        self,
        previous_width: int,
        shape: StageShape,
        layers: str,
        blocks: Mapping[str, Component],
        merge: bool = False,
        has_global: bool = False,
    ):
        super().__init__()
        self.merge = TokenMerge(previous_width, shape.width) if merge else None
        same = previous_width == shape.width
        unused = merge and not has_global  # after a merge only global tokens are left to project
        self.project = nn.Identity() if same or unused else nn.Linear(previous_width, shape.width)
        letters = parse_layer_mix(layers, set(blocks))
        self.layers = Layers(build_component(blocks[letter], shape) for letter in letters)

    def forward(
        self,
        tokens: Float[Tensor, "B V h w d"],
        global_tokens: Float[Tensor, "B G d"] | None = None,
    ) -> tuple[Float[Tensor, "B V h2 w2 e"], Float[Tensor, "B G e"] | None]:
        """Return the tokens, and the global tokens if there are any, after this stage."""
        tokens = self.project(tokens) if self.merge is None else self.merge(tokens)
        if global_tokens is None:
            return self.layers(tokens), None
        sequence = torch.cat((self.project(global_tokens), tokens.flatten(1, 3)), dim=1)
        # As one row of one image: none of these layers depends on the tokens' places.
        sequence = self.layers(sequence[:, None, None])[:, 0, 0]
        count = global_tokens.shape[1]
        return sequence[:, count:].reshape(tokens.shape), sequence[:, :count]


class TokenMerge(nn.Module):
    """A convolution of stride 2 that turns 2 x 2 tokens of a view into one of the new width.

    As in Long-LRM (Ziwen et al. 2025), each old channel makes the same number of new ones. If the
    new width is no multiple of the old, the smallest groups of channels that divide both do.
    """

    def __init__(self, width: int, new_width: int):
        super().__init__()
        groups = math.gcd(width, new_width)
        self.conv = nn.Conv2d(width, new_width, kernel_size=2, stride=2, groups=groups)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h//2 w//2 e"]:
        maps = rearrange(tokens, "b v h w d -> (b v) d h w")
        return rearrange(self.conv(maps), "(b v) d h w -> b v h w d", b=len(tokens))


def parse_layer_mix(mix: str, letters: set[str]) -> list[str]:
    """Return one letter for each layer: "4m4s" (or "4m+4s") gives m m m m s s s s."""
    terms = re.findall(r"(\d{1,3})([a-z])", mix)
    total = sum(int(count) for count, _ in terms)
    known = letters.issuperset(letter for _, letter in terms)
    well_formed = "".join(f"{count}{letter}" for count, letter in terms) == mix.replace("+", "")
    if not (well_formed and known and 0 < total <= MAX_LAYERS):
        raise InputError(
            f"model.layers={mix[:80]!r}: expected counts and letters of {sorted(letters)}, "
            f"such as 4m4s or 7m1t, at most {MAX_LAYERS} in all."
        )
    return [letter for count, letter in terms for _ in range(int(count))]
