"""The sizes of a model: the widths of its network stages."""

from collections.abc import Sequence
from dataclasses import dataclass

from asysplat.errors import InputError


@dataclass(frozen=True)
class StageShape:
    """The sizes of every block of a network stage.

    Args:
        width: d_s, or d_f in the appearance branch.
        head_dim: channels of one attention or Mamba2 head; divides every width.
        mlp_ratio: r_s, hidden over outer width of the stage's MLPs.
    """

    width: int
    head_dim: int
    mlp_ratio: int


@dataclass(frozen=True)
class Widths:
    """Every width of a model.

    Args:
        stages: (d_1, d_2, d_3) of the geometry branch.
        fine: d_f of the appearance branch.
        head_dim: channels of one attention or Mamba2 head; divides all others.
    """

    stages: tuple[int, ...]
    fine: int
    head_dim: int

    def scaled(self, factor: float) -> "Widths":
        """Multiply the widths by `factor`; keep the number of heads, of at least 4 channels."""
        head_dim = max(4, round(self.head_dim * factor / 4) * 4)
        stages = tuple(width // self.head_dim * head_dim for width in self.stages)
        return Widths(stages, self.fine // self.head_dim * head_dim, head_dim)

    def stage_shapes(
        self, stage_ratios: Sequence[int], **per_stage: Sequence[object]
    ) -> list[StageShape]:
        """Return the shape of each stage.

        Args:
            stage_ratios: MLP ratio of each stage.
            per_stage: other options with one entry for each stage.
        """
        for name, values in {"stage_ratios": stage_ratios, **per_stage}.items():
            if len(values) != len(self.stages):
                raise InputError(
                    f"model.{name} has {len(values)} entries for {len(self.stages)} stages of "
                    "model.stage_widths: give one for each stage."
                )
        return [
            StageShape(width, self.head_dim, ratio)
            for width, ratio in zip(self.stages, stage_ratios, strict=True)
        ]
