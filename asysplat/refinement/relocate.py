"""Gaussians of no use move to where others are, by which `densify="error"` is measured.

"3D Gaussian Splatting as Markov Chain Monte Carlo", Kheradmand et al. 2024.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.refinement.densify import LEAST_OPACITY
from asysplat.refinement.fields import Fields
from asysplat.rendering.reference.math import rotations
from asysplat.scene import Gaussians

REGULARIZER = 0.01  # weight of the mean opacity, and of the mean scale
NOISE = 80.0  # the paper's factor, 5e5, times its rate of means, 1.6e-4
SHARPNESS = 100  # of the sigmoid by which opacity stills the noise
STILL = 0.1  # opacity from which on that leaves less than 1e-4 of it
MOST_AT_ONE = 51  # Gaussians that may come to share a place, as in the paper's code


def regularizer(gaussians: Gaussians) -> Tensor:
    """Compute the term of the loss by which Gaussians fade and shrink that are not needed."""
    return REGULARIZER * (gaussians.opacities.mean() + gaussians.scales.mean())


@torch.no_grad()
def relocate(fields: Fields, most: int, growth: float, generator: torch.Generator) -> None:
    """Move dead Gaussians to live ones, drawn by opacity, then add copies of others so drawn.

    Those that come to share a place look together as the one that was there. A copy and what it
    was copied from have no steps yet.

    Args:
        fields: of the Gaussians, in whose order the changed ones come last.
        most: Gaussians up to which copies are added.
        growth: share of the Gaussians that is added.
        generator: of random numbers.
    """
    alive = fields.gaussians().opacities > LEAST_OPACITY
    if alive.any():
        _copy(fields, alive.nonzero()[:, 0], int((~alive).sum()), generator)
    count = len(fields)
    added = min(most - count, int(growth * count))
    _copy(fields, torch.arange(count), max(0, added), generator)


@torch.no_grad()
def shake(fields: Fields, factor: float, generator: torch.Generator) -> None:
    """Move faint Gaussians by chance, as far as they reach themselves (Eq. 8).

    Args:
        fields: of the Gaussians, in the scene's unit: the farthest camera is at distance 1.
        factor: of all rates.
        generator: of random numbers.
    """
    gaussians = fields.gaussians()
    faint = torch.nonzero(gaussians.opacities < STILL)[:, 0]
    gaussians = gaussians.map(lambda field: field[faint])
    gate = torch.sigmoid(SHARPNESS * (LEAST_OPACITY - gaussians.opacities))
    noise = torch.randn(len(faint), 3, generator=generator) * (NOISE * factor * gate)[:, None]
    axes = rotations(gaussians.quats) * gaussians.scales[:, None]
    moved = axes @ (axes.mT @ noise[..., None])
    fields.numbers["offsets"][faint] += moved[..., 0] / fields.units[faint, None]


def shared(
    opacities: Float[Tensor, "N"], scales: Float[Tensor, "N 3"], counts: Int[Tensor, "N"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Return what each of several at one place has, so that they look as one did (Eq. 9).

    The paper's double sum of binomials is sum_k C(n, k) (-1)^(k+1) o^k / sqrt(k), k = 1 to n.

    Args:
        opacities, scales: of the one.
        counts: n >= 1, of those in its place; more than MOST_AT_ONE count as that many.
    """
    counts, before = counts.clamp(max=MOST_AT_ONE), opacities.double().clamp(max=1 - 1e-6)
    each = 1 - (1 - before) ** (1 / counts)
    term, total = -torch.ones_like(each), torch.zeros_like(each)
    for k in range(1, int(counts.max()) + 1):
        term = -term * each * (counts - k + 1) / k  # C(n, k) (-1)^(k+1) o^k, 0 where k > n
        total = total + term / k**0.5
    factors = (before / total).to(scales)
    return each.to(opacities).clamp_min(LEAST_OPACITY), scales * factors[:, None]


def _copy(fields: Fields, rows: Int[Tensor, "M"], count: int, generator: torch.Generator) -> None:
    """Keep `rows`, and `count` copies of some, drawn by opacity with replacement."""
    if count == 0:
        return
    gaussians, units = fields.gaussians(), fields.units
    chances = gaussians.opacities[rows].clamp_min(1e-6)
    drawn = torch.multinomial(chances, count, replacement=True, generator=generator)
    counts = torch.bincount(drawn, minlength=len(rows)) + 1
    several = counts > 1
    copied = rows[several].repeat_interleave(counts[several])
    gaussians = gaussians.map(lambda field: field[copied])
    counts = counts[several].repeat_interleave(counts[several])
    opacities, scales = shared(gaussians.opacities, gaussians.scales, counts)
    fields.keep(rows[~several])
    fields.append(replace(gaussians, opacities=opacities, scales=scales), units[copied])
