"""What a rendering is asked for, as every backend takes it."""

from dataclasses import dataclass, fields

from asysplat.errors import InputError
from asysplat.rendering.convention import INRIA, Convention

DEPTHS = ("accumulated", "expected", "median")


@dataclass(frozen=True)
class Skips:
    """Work that is left out without changing a bit of the image or of a gradient; each can be
    switched off.

    Args:
        opacity: Gaussians below alpha_min are culled before they are projected.
        frustum: what does not reach into the image is culled before its colour is computed.
        extent: a splat reaches to where its own alpha falls below alpha_min, not that of an
            opaque one.
        ellipse: tiles that its ellipse does not touch are left out, not only those its box misses.
        masks: tiles in which no pixel counts.
        rows: in a tile, pixel rows out of its reach.
        opaque: what lies behind rows and tiles that are opaque.
    """

    opacity: bool = True
    frustum: bool = True
    extent: bool = True
    ellipse: bool = True
    masks: bool = True
    rows: bool = True
    opaque: bool = True

    def without(self, name: str) -> "Skips":
        """All of these but `name`."""
        return Skips(**{f.name: getattr(self, f.name) and f.name != name for f in fields(self)})


@dataclass(frozen=True)
class Settings:
    """How to draw.

    Args:
        convention: cut-offs of alpha compositing.
        antialiased: opacity is lowered by what eps2d adds to a splat's area (Yu et al. 2024).
        depth: one of DEPTHS, or None.
        skips: work to leave out.

    Raises:
        InputError: an unknown depth.
    """

    convention: Convention = INRIA
    antialiased: bool = False
    depth: str | None = "expected"
    skips: Skips = Skips()

    def __post_init__(self):
        if self.depth is not None and self.depth not in DEPTHS:
            raise InputError(
                f"render's depth is {self.depth!r}: choose True, False or one of "
                f"{', '.join(DEPTHS)}."
            )
