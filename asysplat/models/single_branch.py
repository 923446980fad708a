"""Models of one branch: the paper's single-branch ablation, and Long-LRM, its baseline."""

from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.attention import SparseAttention
from asysplat.models.head import GaussianHead
from asysplat.models.layers import Tokenizer, Widths
from asysplat.models.network import Prune, TokenNetwork
from asysplat.models.stage import Component, Stage, build_component


class SingleBranch(TokenNetwork):
    """Tokens of one patch size through all stages; every pixel gives a Gaussian.

    Args:
        widths, prune: see TokenNetwork; `widths.fine` is not used.
        stage_ratios, stage_layers, blocks: see AsySplat; each stage has a layer mix.
        merges: whether 2 x 2 tokens become one, before each stage.
        patch: side of a token's patch before any merge.
        global_tokens: number of learned tokens that come first in the sequence and have no place.
    """

    def __init__(
        self,
        widths: Widths,
        stage_ratios: Sequence[int],
        stage_layers: Sequence[str],
        merges: Sequence[bool],
        blocks: Mapping[str, Component],
        head: Callable[..., GaussianHead],
        patch: int = 8,
        global_tokens: int = 0,
        prune: Prune | None = None,
    ):
        super().__init__(widths, patch * 2 ** sum(merges), prune)
        self.tokenizer = build_component(Tokenizer, patch, widths.stages[0], bias=False)
        shapes = widths.stage_shapes(stage_ratios, stage_layers=stage_layers, merges=merges)
        self.stages = nn.ModuleList(
            build_component(Stage, previous.width, shape, layers, blocks, merge, global_tokens > 0)
            for previous, shape, layers, merge in zip(
                [shapes[0], *shapes[:-1]], shapes, stage_layers, merges, strict=True
            )
        )
        if global_tokens and any(isinstance(m, SparseAttention) for m in self.modules()):
            raise InputError(
                f"model.global_tokens={global_tokens} with sparse attention among "
                f"model.stage_layers={list(stage_layers)}: global tokens have no place in an "
                "image; take layers m and t, or model.global_tokens=0."
            )
        self.global_tokens = None
        if global_tokens:
            start = nn.init.trunc_normal_(torch.empty(global_tokens, shapes[0].width), std=0.02)
            self.global_tokens = nn.Parameter(start)
        self.head = build_component(head, widths.stages[-1], self.patch, self.patch)

    def tokens(self, pixels: Float[Tensor, "B V H W c"]) -> Float[Tensor, "B V h w d"]:
        tokens = self.tokenizer(pixels)
        global_tokens = None
        if self.global_tokens is not None:
            global_tokens = self.tokenizer.norm(self.global_tokens).expand(len(tokens), -1, -1)
        for stage in self.stages:
            tokens, global_tokens = stage(tokens, global_tokens)
        return tokens


def build_single_branch(
    stage_widths: Sequence[int],
    head_dim: int = 64,
    width: float = 1.0,
    geometry_ratio: float | None = None,
    parameter_budget: float = 1.0,
    **components,
) -> SingleBranch:
    """Build a SingleBranch of the given widths times `width`; `components`: its other arguments.

    There is one branch: `geometry_ratio` and `parameter_budget` must be None and 1.
    """
    refuse_ratio(geometry_ratio, parameter_budget)
    widths = Widths(tuple(stage_widths), head_dim, head_dim).scaled(width)
    return SingleBranch(widths, **components)


def refuse_ratio(geometry_ratio: float | None, parameter_budget: float) -> None:
    """Raise InputError unless both have the values of a model without two branches."""
    if geometry_ratio is not None or parameter_budget != 1:
        raise InputError(
            f"geometry_ratio={geometry_ratio} and parameter_budget={parameter_budget} have no "
            "meaning for a model of one branch: leave them out, or take an asysplat_* model."
        )
