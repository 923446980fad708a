"""Models of one branch: the paper's single-branch ablation, and Long-LRM, its baseline."""

import math
from collections.abc import Collection, Mapping, Sequence

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.attention import SparseAttention
from asysplat.models.network import Network
from asysplat.models.shapes import StageShape, Widths
from asysplat.models.stage import Component, build_layers, to_width
from asysplat.models.tokenizer import Tokenizer


class SingleBranch(Network):
    """Tokens of one patch size through all stages; every pixel gives a Gaussian.

    Args:
        widths: of the network stages; `widths.fine` is not used.
        stage_ratios: MLP ratio of each stage.
        stage_layers: layer mix of each stage, counts and letters of `blocks`.
        merges: whether 2 x 2 tokens become one before the stage.
        blocks: letter -> component built from a StageShape.
        head: component that decodes Gaussians.
        patch: side of a token's patch before any merge.
        global_tokens: number of learned tokens that come before the others and have no place.
        prior: of Network.

    Raises:
        InputError: lists of unequal length, an unusable layer mix, or global tokens with sparse
            attention, which sorts tokens by their places.
    """

    def __init__(
        self,
        widths: Widths,
        stage_ratios: Sequence[int],
        stage_layers: Sequence[str],
        merges: Sequence[bool],
        blocks: Mapping[str, Component],
        head: Component,
        patch: int = 8,
        global_tokens: int = 0,
        prior: nn.Module | None = None,
    ):
        super().__init__(widths, patch * 2 ** sum(merges), prior)
        lists = {"stage_ratios": stage_ratios, "stage_layers": stage_layers, "merges": merges}
        for name, values in lists.items():
            if len(values) != len(widths.stages):
                raise InputError(
                    f"model.{name} has {len(values)} entries for {len(widths.stages)} stages of "
                    "model.stage_widths: give one a stage."
                )
        self.tokenizer = Tokenizer(patch, widths.stages[0], self.pixel_channels)
        shapes = [
            StageShape(width, widths.head_dim, ratio)
            for width, ratio in zip(widths.stages, stage_ratios, strict=True)
        ]
        self.stages = nn.ModuleList(
            MergingStage(previous.width, shape, layers, blocks, merge, global_tokens > 0)
            for previous, shape, layers, merge in zip(
                [shapes[0], *shapes[:-1]], shapes, stage_layers, merges, strict=True
            )
        )
        if global_tokens and any(isinstance(m, SparseAttention) for m in self.modules()):
            raise InputError(
                f"model.global_tokens={global_tokens} with sparse attention among "
                f"model.stage_layers={list(stage_layers)}: global tokens have no place in a frame; "
                "take layers m and t, or model.global_tokens=0."
            )
        self.global_tokens = None
        if global_tokens:
            start = nn.init.trunc_normal_(torch.empty(global_tokens, shapes[0].width), std=0.02)
            self.global_tokens = nn.Parameter(start)
        self.head = head(widths.stages[-1], self.patch, self.patch)

    def tokens(
        self, pixels: Float[Tensor, "B V H W c"], without: Collection[nn.Module] = ()
    ) -> Float[Tensor, "B V h w d"]:
        tokens = self.tokenizer(pixels)
        extra = None
        if self.global_tokens is not None:
            extra = self.tokenizer.norm(self.global_tokens).expand(len(tokens), -1, -1)
        for stage in self.stages:
            tokens, extra = stage(tokens, extra, without)
        return tokens

    def geometry_share(self) -> float:
        """Return 1: there is no appearance branch."""
        return 1.0


class MergingStage(nn.Module):
    """A network stage that merges or projects its tokens, then applies the layer mix.

    The layers see the global tokens and the others as one sequence.

    Args:
        previous_width: of the tokens that come in.
        shape: of this stage.
        layers: the layer mix, letters of `blocks`.
        blocks: letter -> component built from a StageShape.
        merge: whether 2 x 2 tokens become one.
        has_global: whether there are global tokens.
    """

    def __init__(
        self,
        previous_width: int,
        shape: StageShape,
        layers: str,
        blocks: Mapping[str, Component],
        merge: bool,
        has_global: bool,
    ):
        super().__init__()
        self.merge = TokenMerge(previous_width, shape.width) if merge else None
        # After a merge only the global tokens are left to project.
        needed = has_global or not merge
        self.project = to_width(previous_width, shape.width) if needed else None
        self.layers = build_layers(shape, layers, blocks)

    def forward(
        self,
        tokens: Float[Tensor, "B V h w d"],
        extra: Float[Tensor, "B G d"] | None,
        without: Collection[nn.Module] = (),
    ) -> tuple[Float[Tensor, "B V h2 w2 e"], Float[Tensor, "B G e"] | None]:
        tokens = self.project(tokens) if self.merge is None else self.merge(tokens)
        if extra is None:
            return self.layers(tokens, without), None
        sequence = torch.cat((self.project(extra), tokens.flatten(1, 3)), dim=1)
        # As one row of one frame: none of these layers looks at places.
        sequence = self.layers(sequence[:, None, None], without)[:, 0, 0]
        count = extra.shape[1]
        return sequence[:, count:].reshape(tokens.shape), sequence[:, :count]


class TokenMerge(nn.Module):
    """A convolution of stride 2 that turns 2 x 2 tokens of a frame into one of the new width.

    As in Long-LRM (Ziwen et al. 2025), each old channel makes the same number of new ones. Where
    the new width is no multiple of the old, the smallest groups of channels that divide both do.
    """

    def __init__(self, width: int, new_width: int):
        super().__init__()
        groups = math.gcd(width, new_width)
        self.conv = nn.Conv2d(width, new_width, kernel_size=2, stride=2, groups=groups)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h//2 w//2 e"]:
        maps = rearrange(tokens, "b v h w d -> (b v) d h w")
        return rearrange(self.conv(maps), "(b v) d h w -> b v h w d", b=len(tokens))


def build_single_branch(
    stage_widths: Sequence[int],
    head_dim: int = 64,
    width: float = 1.0,
    geometry_ratio: float | None = None,
    parameter_budget: float = 1.0,
    **components,
) -> SingleBranch:
    """Build a SingleBranch of the given widths times `width`.

    Args:
        stage_widths, head_dim: at width 1.
        width: multiplies the widths.
        geometry_ratio, parameter_budget: must be None and 1: there is nothing to share.
        components: the other arguments of SingleBranch.

    Raises:
        InputError: a geometry_ratio or a budget.
    """
    if geometry_ratio is not None or parameter_budget != 1:
        raise InputError(
            f"geometry_ratio={geometry_ratio} and parameter_budget={parameter_budget} have no "
            "meaning for a model of one branch: leave them out, or take an asysplat_* model."
        )
    widths = Widths(tuple(stage_widths), head_dim, head_dim).scaled(width)
    return SingleBranch(widths, **components)
