"""Densification of 3DGS-MCMC (Kheradmand et al. 2024): relocate dead Gaussians to live ones."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.geometry.motion import rotations
from asysplat.kernels.dispatch import to_float64
from asysplat.refinement.densification import Densifier
from asysplat.refinement.densification.spawn import MIN_OPACITY
from asysplat.refinement.fields import Fields
from asysplat.refinement.footprints import random_normal
from asysplat.scene import Gaussians, Views

REGULARIZER = 0.01  # weight of the mean opacity, and of the mean scale
NOISE = 80.0  # the paper's factor, 5e5, times its learning rate of means, 1.6e-4
SHARPNESS = 100  # steepness of the sigmoid of opacity that gates the noise
NOISE_MAX_OPACITY = 0.1  # above it the gate is below 1e-4, and the noise is left out
MAX_COPIES = 51  # Gaussians at one position for which Eq. 9 is evaluated, as in the paper's code


class McmcDensifier(Densifier):
    """Relocates dead Gaussians and adds copies; noise explores positions."""

    def __init__(self, fields: Fields, generator: torch.Generator):
        self.fields, self.generator = fields, generator

    def observe_step(self, visible: Bool[Tensor, "N"], factor: float) -> None:
        inject_position_noise(self.fields, factor, self.generator)

    def densify(self, views: Views, target: int) -> None:
        relocate(self.fields, target, self.generator)


def mcmc_regularizer(gaussians: Gaussians) -> Tensor:
    """Compute the loss term that makes unneeded Gaussians transparent and small."""
    return REGULARIZER * (gaussians.opacities.mean() + gaussians.scales.mean())


@torch.no_grad()
def relocate(fields: Fields, target: int, generator: torch.Generator) -> None:
    """Move dead Gaussians to live ones sampled by opacity, then add copies sampled likewise.

    Copies, added up to `target` Gaussians, render together with their original as it did. Both get
    a new optimizer state, and are moved to the end.
    """
    alive = fields.gaussians().opacities > MIN_OPACITY
    if alive.any():
        _copy(fields, alive.nonzero()[:, 0], int((~alive).sum()), generator)
    count = len(fields)
    every = torch.arange(count, device=fields.units.device)
    _copy(fields, every, max(0, target - count), generator)


@torch.no_grad()
def inject_position_noise(fields: Fields, factor: float, generator: torch.Generator) -> None:
    """Add noise to the positions of faint Gaussians, shaped by their covariance (Eq. 8).

    `factor` is that of the learning rates; the scene's farthest camera is at distance 1.
    """
    gaussians = fields.gaussians()
    faint = torch.nonzero(gaussians.opacities < NOISE_MAX_OPACITY)[:, 0]
    gaussians = gaussians.map(lambda field: field[faint])
    gate = torch.sigmoid(SHARPNESS * (MIN_OPACITY - gaussians.opacities))
    noise = random_normal(len(faint), 3, generator) * (NOISE * factor * gate)[:, None]
    axes = rotations(gaussians.quats) * gaussians.scales[:, None]
    shift = axes @ (axes.mT @ noise[..., None])
    fields.parameters["offsets"][faint] += shift[..., 0] / fields.units[faint, None]


def split_opacity_and_scale(
    opacities: Float[Tensor, "N"], scales: Float[Tensor, "N 3"], counts: Int[Tensor, "N"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Compute the opacity and the scale of n copies that render together as their original (Eq. 9).

    The paper's double sum of binomials is sum_k C(n, k) (-1)^(k+1) o^k / sqrt(k), k = 1 to n. More
    copies than MAX_COPIES count as that many; `counts` are >= 1.
    """
    counts, before = counts.clamp(max=MAX_COPIES), to_float64(opacities).clamp(max=1 - 1e-6)
    reduced = 1 - (1 - before) ** (1 / counts)
    term, total = -torch.ones_like(reduced), torch.zeros_like(reduced)
    for k in range(1, int(counts.max()) + 1):
        term = -term * reduced * (counts - k + 1) / k  # C(n, k) (-1)^(k+1) o^k, 0 where k > n
        total = total + term / k**0.5
    factors = (before / total).to(scales)
    return reduced.to(opacities).clamp_min(MIN_OPACITY), scales * factors[:, None]


def _copy(fields: Fields, rows: Int[Tensor, "M"], count: int, generator: torch.Generator) -> None:
    """Keep `rows`, and add `count` copies sampled by opacity with replacement."""
    if count == 0:
        return
    gaussians, units = fields.gaussians(), fields.units
    weights = gaussians.opacities[rows].clamp_min(1e-6)
    sampled = torch.multinomial(weights, count, replacement=True, generator=generator)
    counts = torch.bincount(sampled, minlength=len(rows)) + 1
    several = counts > 1
    copied = rows[several].repeat_interleave(counts[several])
    gaussians = gaussians.map(lambda field: field[copied])
    counts = counts[several].repeat_interleave(counts[several])
    opacities, scales = split_opacity_and_scale(gaussians.opacities, gaussians.scales, counts)
    fields.keep(rows[~several])
    fields.append(replace(gaussians, opacities=opacities, scales=scales), units[copied])
