"""The arguments and results of a rendering backend."""

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

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

    The renderers that define these limits compute in float32, where two clamped alphas reach the
    stop; float64 has to take the same decisions.
    """
    return float(np.float32(value))


@dataclass(frozen=True)
class BlendingLimits:
    """The cut-offs of alpha compositing, which decide the value of a pixel; a PSNR depends on them.

    The Gaussian that would push the transmittance below its minimum is dropped, with all behind it.
    """

    alpha_max: float = single(0.99)  # alpha is clamped to it
    alpha_min: float = single(1 / 255)  # a smaller alpha counts as 0
    transmittance_min: float = single(1e-4)
    eps2d: float = 0.3  # variance added to every projected Gaussian, in pixels squared
    near: float = 0.01  # Gaussians whose mean has at most this depth are culled, in scene units
    frustum_margin: float = 0.15  # the Jacobian is taken in the view, widened by it on each side
    compensation_min: float = 2.5e-5  # of the squared factor of the opacity for antialiasing


# diff-gaussian-rasterization (Kerbl et al. 2023) and gsplat 1.6; their near planes differ.
INRIA = BlendingLimits()
# gsplat 1.5.3 clamps alpha later.
GSPLAT_1_5 = BlendingLimits(alpha_max=single(0.999))
BLENDING_LIMITS = {"inria": INRIA, "gsplat-1.5": GSPLAT_1_5}


@dataclass(frozen=True)
class Culling:
    """Exact culling: work that can be left out without changing a bit of an image or a gradient."""

    opacity: bool = True  # Gaussians below alpha_min, before the projection
    frustum: bool = True  # Gaussians outside the image, before their color is computed
    extent: bool = True  # of a splat beyond its own alpha_min, not only that of an opaque splat
    ellipse: bool = True  # tiles of a splat's box that its ellipse does not touch
    masks: bool = True  # tiles without a pixel that counts
    rows: bool = True  # rows of a tile's pixels that a splat does not reach; on a CPU alone
    opaque: bool = True  # splats behind opaque rows and tiles


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
    """Settings of a rendering."""

    limits: BlendingLimits = INRIA
    antialiased: bool = False  # the opacity is lowered by what eps2d adds to a splat's area
    depth: str | None = "expected"  # one of DEPTHS, or None
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


class RenderStatistics(Mapping):
    """Numbers by name, counted when one is first read: until then nobody waits for a GPU."""

    def __init__(self, count: Callable[[], dict[str, int]]):
        self._count = count

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return self._count()

    def __getitem__(self, name: str) -> int:
        return self._numbers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)


@dataclass(frozen=True)
class RenderOutputs:
    """Images without background; I counts the views of all scenes.

    The depth is the sum of w_i (z_i - depth_origin), or that of the Gaussian that takes the
    transmittance to half or below, 0 where none does; None if settings.depth is None. Its origin,
    without a gradient, is near the blended depths, so that their differences are not lost to
    rounding; None for 0.
    """

    image: Float[Tensor, "I 3 H W"]  # sum of w_i c_i
    alpha: Float[Tensor, "I H W"]  # sum of w_i
    transmittance: Float[Tensor, "I H W"]  # 1 - alpha, to float32's relative precision also near 0
    depth: Float[Tensor, "I H W"] | None
    stats: dict[str, int] | RenderStatistics
    depth_origin: Float[Tensor, "I H W"] | None = None


def check_pairs(pairs: int, longest: int = 0) -> None:
    """Raise InputError for too many pairs of Gaussian and tile, in all or in the `longest` list."""
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
    """Raise InputError if a GPU cannot number the splats of so many images of `num` Gaussians."""
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
