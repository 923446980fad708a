"""The sizes of a model: the widths of its network stages."""

from dataclasses import dataclass


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
