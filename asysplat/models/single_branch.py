"""One branch for everything: the paper's single-branch ablation, and Long-LRM, its baseline."""

from collections.abc import Mapping, Sequence

from torch import nn

from asysplat.errors import InputError
from asysplat.models.network import Network
from asysplat.models.shapes import StageShape, Widths
from asysplat.models.stage import Component, Stage
from asysplat.models.tokenizer import Tokenizer, pixel_features
from asysplat.scene import Gaussians, Views


class SingleBranch(Network):
    """Tokens of one patch size through all stages; every pixel gives a Gaussian.

    Args:
        widths: of the stages; `widths.fine` is not used.
        stage_ratios: MLP ratio of each stage.
        stage_layers: layer mix of each stage, letters of `blocks`.
        merges: whether 2 x 2 tokens become one before the stage.
        blocks: letter -> component built from a StageShape.
        head: component that decodes Gaussians.
        patch: side of a token's patch before any merge.

    Raises:
        InputError: lists of unequal length, or an unusable layer mix.
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
    ):
        super().__init__(widths, patch * 2 ** sum(merges))
        lists = {"stage_ratios": stage_ratios, "stage_layers": stage_layers, "merges": merges}
        for name, values in lists.items():
            if len(values) != len(widths.stages):
                raise InputError(
                    f"model.{name} has {len(values)} entries for {len(widths.stages)} stages of "
                    "model.stage_widths: give one a stage."
                )
        self.tokenizer = Tokenizer(patch, widths.stages[0])
        shapes = [
            StageShape(width, widths.head, ratio)
            for width, ratio in zip(widths.stages, stage_ratios, strict=True)
        ]
        self.stages = nn.ModuleList(
            Stage(previous.width, shape, layers, blocks, merge)
            for previous, shape, layers, merge in zip(
                [shapes[0], *shapes[:-1]], shapes, stage_layers, merges, strict=True
            )
        )
        self.head = head(widths.stages[-1], self.patch, self.patch)

    def predict(self, views: Views) -> Gaussians:
        """Views [B, V] -> Gaussians [B, N], N = V H W."""
        tokens = self.tokenizer(pixel_features(views))
        for stage in self.stages:
            tokens = stage(tokens)
        return self.head(tokens, views)

    def geometry_share(self) -> float:
        """There is no appearance branch: 1."""
        return 1.0


def build_single_branch(
    stage_widths: Sequence[int],
    head_width: int = 64,
    width: float = 1.0,
    geometry_ratio: float | None = None,
    parameter_budget: float = 1.0,
    **components,
) -> SingleBranch:
    """A SingleBranch of the given widths times `width`.

    Args:
        stage_widths, head_width: at width 1.
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
    widths = Widths(tuple(stage_widths), head_width, head_width).scaled(width)
    return SingleBranch(widths, **components)
