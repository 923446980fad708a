"""The constants that decide which Gaussians a pixel sees; a PSNR depends on them."""

from dataclasses import dataclass

import numpy as np

LARGEST = 1e18  # depths and harmonics beyond it are culled: their squares overflow float32


def single(value: float) -> float:
    """The float32 nearest to `value`: the renderers that set these constants compute in float32,
    where two clamped alphas reach the stop, and float64 has to decide as they do."""
    return float(np.float32(value))


@dataclass(frozen=True)
class Convention:
    """Cut-offs of alpha compositing.

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
