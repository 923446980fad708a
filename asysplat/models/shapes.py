"""The sizes of a model: the widths of its stages and what follows from them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class StageShape:
    """What every block of one geometry stage is built from.

    Args:
        width: d_s.
        head_width: of attention and Mamba2 heads; divides every width.
        mlp_ratio: r_s, hidden over outer width of the stage's MLPs.
    """

    width: int
    head_width: int
    mlp_ratio: int


@dataclass(frozen=True)
class Widths:
    """Every width of a model.

    Args:
        stages: (d_1, d_2, d_3) of the geometry branch.
        fine: d_f of the appearance branch.
        head: width of one attention or Mamba2 head; divides all others.
    """

    stages: tuple[int, ...]
    fine: int
    head: int

    def scaled(self, factor: float) -> "Widths":
        """The widths times `factor`, the same number of heads; a head is at least 4 wide."""
        head = max(4, round(self.head * factor / 4) * 4)
        return Widths(
            tuple(w // self.head * head for w in self.stages), self.fine // self.head * head, head
        )
