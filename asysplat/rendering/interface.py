"""The arguments and results of a rendering backend."""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import TensorRecord

DEPTHS = ("accumulated", "expected", "median")
MAX_MAGNITUDE = 1e18  # limit of depths and SH coefficients: more is culled, as squares overflow
MAX_PAIRS = 2**31 - 1  # pairs of splat and tile that int32 can number
MAX_SPLATS_PER_TILE = 2**24  # what float32 can count
MAX_SPLATS = 2**31 - 1  # Gaussians of all views together that int32 can number
MAX_IMAGES = 2**16 - 1  # views of all scenes that a GPU launches programs for


def single(value: float) -> float:
    """Return the float32 nearest to `value`.

    The renderers that define the constants below compute in float32, where two clamped alphas reach
    the stop, and float64 has to take the same decisions.
    """
    return float(np.float32(value))


@dataclass(frozen=True)
class BlendingLimits:
    """The cut-offs of alpha compositing, which decide the value of a pixel; a PSNR depends on them.

    Args:
        alpha_max: alpha is clamped to this value.
        alpha_min: a smaller alpha counts as 0.
        transmittance_min: the Gaussian that would push the transmittance below this value is
            dropped, with all behind it.
        eps2d: variance added to every projected Gaussian, in pixels squared.
        near: Gaussians whose mean has a depth <= near are culled, in scene units.
        frustum_margin: the Jacobian is taken inside the view widened by this fraction on each side.
        compensation_min: minimum of the squared factor of the opacity for antialiasing.
    """

    alpha_max: float = single(0.99)
    alpha_min: float = single(1 / 255)
    transmittance_min: float = single(1e-4)
    eps2d: float = 0.3
    near: float = 0.01
    frustum_margin: float = 0.15
    compensation_min: float = 2.5e-5


# diff-gaussian-rasterization (Kerbl et al. 2023) and gsplat 1.6; their near planes differ.
INRIA = BlendingLimits()
# gsplat 1.5.3 clamps alpha later.
GSPLAT_1_5 = BlendingLimits(alpha_max=single(0.999))
BLENDING_LIMITS = {"inria": INRIA, "gsplat-1.5": GSPLAT_1_5}


@dataclass(frozen=True)
class Culling:
    """Exact culling: work that can be left out without changing a bit of an image or a gradient.

    `without_culling` switches kinds off.

    Args:
        opacity: cull Gaussians below alpha_min before the projection.
        frustum: cull Gaussians outside the image before their color is computed.
        extent: end a splat where its own alpha falls below alpha_min, not where that of an opaque
            splat does.
        ellipse: cull tiles of a splat's box that its ellipse does not touch.
        masks: cull tiles without a pixel that counts.
        rows: cull rows of a tile's pixels that a splat does not reach.
        opaque: cull splats behind opaque rows and tiles.
    """

    opacity: bool = True
    frustum: bool = True
    extent: bool = True
    ellipse: bool = True
    masks: bool = True
    rows: bool = True
    opaque: bool = True


_culling = Culling()


@contextmanager
def without_culling(*kinds: str) -> Generator[None]:
    """Switch kinds of culling off while the block runs, to test and to time what they save."""
    global _culling
    before, _culling = _culling, replace(_culling, **dict.fromkeys(kinds, False))
    try:
        yield
    finally:
        _culling = before


@dataclass(frozen=True)
class RenderSettings:
    """Settings of a rendering.

    Args:
        limits: cut-offs of alpha compositing.
        antialiased: lower the opacity by what eps2d adds to a splat's area (Yu et al. 2024).
        depth: one of DEPTHS, or None.
        culling: exact culling.
    """

    limits: BlendingLimits = INRIA
    antialiased: bool = False
    depth: str | None = "expected"
    culling: Culling = field(default_factory=lambda: _culling)

    def __post_init__(self):
        if self.depth is not None and self.depth not in DEPTHS:
            raise InputError(
                f"render's depth is {self.depth!r}: choose True, False or one of "
                f"{', '.join(DEPTHS)}."
            )


@dataclass(frozen=True)
class Projections(TensorRecord):
    """Every Gaussian in every view as a 2D Gaussian, as densification needs it.

    Args:
        means2d: [..., V, N, 2] centers in pixels; a leaf whose .grad a backward pass of the image
            fills, where gradients are enabled.
        conics: [..., V, N, 3] inverse covariances, as (xx, xy, yy), in 1 / pixels^2.
        radii: [..., V, N] three standard deviations along the longer axis, in pixels; 0 where the
            Gaussian is culled.
    """

    means2d: Float[Tensor, "*batch V N 2"]
    conics: Float[Tensor, "*batch V N 3"]
    radii: Float[Tensor, "*batch V N"]


@dataclass(frozen=True)
class RenderOutputs:
    """Images without background; I counts the views of all scenes.

    Args:
        image: [I, 3, H, W] sum of w_i c_i.
        alpha: [I, H, W] sum of w_i.
        transmittance: [I, H, W] 1 - alpha, to float32's relative precision also near 0.
        depth: [I, H, W] sum of w_i (z_i - depth_origin), or the depth of the Gaussian that takes
            the transmittance to half or below, 0 where none does; None if settings.depth is None.
        stats: counts of visible Gaussians, pairs with tiles, and what was culled.
        depth_origin: [I, H, W] without a gradient, near the blended depths, so that their
            differences are not lost to rounding; None for 0.
    """

    image: Float[Tensor, "I 3 H W"]
    alpha: Float[Tensor, "I H W"]
    transmittance: Float[Tensor, "I H W"]
    depth: Float[Tensor, "I H W"] | None
    stats: dict[str, int]
    depth_origin: Float[Tensor, "I H W"] | None = None


def check_pairs(pairs: int, longest: int = 0) -> None:
    """Raise InputError if a backend's lists cannot hold so many entries.

    Args:
        pairs: pairs of Gaussian and tile, at most MAX_PAIRS.
        longest: Gaussians in the fullest tile, at most MAX_SPLATS_PER_TILE.
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


def check_splats(images: int, num: int) -> None:
    """Raise InputError if a GPU cannot number the splats of so many images.

    Args:
        images: views of all scenes, at most MAX_IMAGES.
        num: Gaussians of a scene; those of all images together are at most MAX_SPLATS.
    """
    if images > MAX_IMAGES:
        raise InputError(
            f"render draws {images} views at once, and the limit is {MAX_IMAGES}: set "
            "views_at_once, or render fewer scenes."
        )
    if images * num > MAX_SPLATS:
        raise InputError(
            f"render projects {num} Gaussians to {images} views at once, and the limit is "
            f"{MAX_SPLATS} in all: set views_at_once, or render fewer scenes."
        )
