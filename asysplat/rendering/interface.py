"""What `render` asks of a backend, and what a backend returns."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError

DEPTHS = ("accumulated", "expected", "median")
MAX_MAGNITUDE = (
    1e18  # depths and SH coefficients beyond it are culled: their squares overflow float32
)
MIN_SQUARED_DISTANCE = 1e-20  # below the square of any distance that matters, and normal in float32
MAX_PAIRS = 2**31 - 1  # of splat and tile: what int32 can number
MAX_SPLATS_PER_TILE = 2**24  # what float32 can count


def single(value: float) -> float:
    """Return the float32 nearest to `value`.

    The renderers that set the constants below compute in float32, where two clamped alphas reach
    the stop, and float64 has to decide as they do.
    """
    return float(np.float32(value))


@dataclass(frozen=True)
class Convention:
    """The cut-offs of alpha compositing, which decide what a pixel sees; a PSNR depends on them.

    Args:
        alpha_max: alpha is clamped to this value.
        alpha_min: a smaller alpha is skipped.
        transmittance_min: the Gaussian that would push the transmittance below this value is
            dropped, with all behind it.
        eps2d: variance added to every projected Gaussian, in pixels squared.
        near: Gaussians whose mean has a depth <= near are culled, in scene units.
        frustum_margin: the Jacobian is taken inside the view widened by this share on each side.
        compensation_min: least share of a splat's area that antialiasing leaves of its opacity,
            squared.
    """

    alpha_max: float = single(0.99)
    alpha_min: float = single(1 / 255)
    transmittance_min: float = single(1e-4)
    eps2d: float = 0.3
    near: float = 0.01
    frustum_margin: float = 0.15
    compensation_min: float = 2.5e-5


# diff-gaussian-rasterization (Kerbl et al. 2023) and gsplat 1.6; their near planes differ.
INRIA = Convention()
# gsplat 1.5.3 clamps alpha later.
GSPLAT_1_5 = Convention(alpha_max=single(0.999))
CONVENTIONS = {"inria": INRIA, "gsplat-1.5": GSPLAT_1_5}


@dataclass(frozen=True)
class Culling:
    """Work that is left out without changing a bit of the image or of a gradient.

    Each skip can be switched off.

    Args:
        opacity: Gaussians below alpha_min are culled before they are projected.
        frustum: Gaussians that show in no pixel of the image are culled before their color is
            computed.
        extent: a splat ends where its own alpha falls below alpha_min, not where that of an opaque
            one does.
        ellipse: tiles that a splat's ellipse does not touch are left out, not only those that its
            box misses.
        masks: tiles in which no pixel counts are left out.
        rows: rows of a tile's pixels that a splat does not show in are left out.
        opaque: what lies behind opaque rows and tiles is left out.
    """

    opacity: bool = True
    frustum: bool = True
    extent: bool = True
    ellipse: bool = True
    masks: bool = True
    rows: bool = True
    opaque: bool = True

    def disable(self, name: str) -> "Culling":
        """Return these skips with `name` switched off."""
        return Culling(**{f.name: getattr(self, f.name) and f.name != name for f in fields(self)})


@dataclass(frozen=True)
class RenderSettings:
    """How to draw.

    Args:
        convention: cut-offs of alpha compositing.
        antialiased: opacity is lowered by what eps2d adds to a splat's area (Yu et al. 2024).
        depth: one of DEPTHS, or None.
        culling: work to leave out.

    Raises:
        InputError: an unknown depth.
    """

    convention: Convention = INRIA
    antialiased: bool = False
    depth: str | None = "expected"
    culling: Culling = Culling()

    def __post_init__(self):
        """Check the name of the depth."""
        if self.depth is not None and self.depth not in DEPTHS:
            raise InputError(
                f"render's depth is {self.depth!r}: choose True, False or one of "
                f"{', '.join(DEPTHS)}."
            )


@dataclass(frozen=True)
class RenderOutputs:
    """Images without background; I counts the views of all scenes.

    Args:
        image: [I, 3, H, W] sum of w_i c_i.
        alpha: [I, H, W] sum of w_i.
        transmittance: [I, H, W] 1 - alpha, but to float32's relative precision also where it is
            nearly 0.
        depth: [I, H, W] sum of w_i (z_i - depth_origin), or the depth of the Gaussian that takes
            the transmittance to half or below, 0 where none does; None unless asked for.
        stats: counts of what was done and of what was skipped.
        depth_origin: [I, H, W] without a gradient, near the depths that are blended, so that their
            differences are not lost to rounding; None for 0.
    """

    image: Float[Tensor, "I 3 H W"]
    alpha: Float[Tensor, "I H W"]
    transmittance: Float[Tensor, "I H W"]
    depth: Float[Tensor, "I H W"] | None
    stats: dict[str, int]
    depth_origin: Float[Tensor, "I H W"] | None = None


def check_pairs(pairs: int, longest: int = 0) -> None:
    """Raise InputError if a backend's lists cannot hold what they would have to.

    Args:
        pairs: pairs of Gaussian and tile, of which a list can number MAX_PAIRS.
        longest: Gaussians in the tile that has most, of which it can count MAX_SPLATS_PER_TILE.
    """
    if longest > MAX_SPLATS_PER_TILE:
        raise InputError(
            f"render finds {longest} Gaussians in one tile, and the limit is "
            f"{MAX_SPLATS_PER_TILE}: render smaller Gaussians, or only the visible ones."
        )
    if pairs > MAX_PAIRS:
        raise InputError(
            f"render needs {pairs} pairs of Gaussian and tile, and the limit is {MAX_PAIRS}: "
            "set views_at_once, or render smaller Gaussians."
        )
