"""Textures of plaster, brick, planks, tiles, cloth or grass, from one formula.

A material is a grid of cells (bricks, planks, checks; one huge cell if plain) with joints, over
fractal noise that blends two colors. The pixel's footprint limits all frequencies.
"""

import colorsys
from dataclasses import astuple, dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.random import Generator
from torch import Tensor

LATTICE = 64  # points after which the noise repeats
OCTAVES = 6
PERSISTENCE = 0.75  # 1 is the 1/f amplitude spectrum of photographs; edges add the rest
PLAIN = 1e6  # a cell so large that its joints are never visible

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """Appearance of a surface; lengths in meters, colors linear RGB."""

    base: Color
    accent: Color
    cell: tuple[float, float] = (PLAIN, PLAIN)
    shift: float = 0.0  # offset of each row of cells from the one below, in cells
    joint: float = 0.0  # width of the joints
    variation: float = 0.0  # brightness differences between cells
    checker: float = 0.0  # brightness difference of a checkered pattern
    grain: tuple[float, float] = (1.0, 1.0)  # lattice points of the coarsest noise a meter
    gloss: float = 0.0  # brightness of a highlight's center
    shininess: float = 1.0  # narrowness of highlights: exponent of Blinn and Phong

    def row(self) -> list[float]:
        """Return all numbers in the order of the fields."""
        return np.hstack(astuple(self)).tolist()


def hsv(hue: float, saturation: float, value: float) -> Color:
    return colorsys.hsv_to_rgb(hue % 1.0, saturation, value)


def plaster(rng: Generator) -> Material:
    hue, value = rng.uniform(0.02, 0.18), rng.uniform(0.45, 0.8)
    if rng.random() < 0.3:
        hue = rng.uniform(0.4, 0.65)
    saturation = rng.uniform(0.05, 0.35)
    return Material(hsv(hue, saturation, value), hsv(hue + 0.03, saturation, 0.55 * value))


def bricks(rng: Generator) -> Material:
    hue, value = rng.uniform(0.0, 0.09), rng.uniform(0.25, 0.6)
    saturation, height = rng.uniform(0.15, 0.6), rng.uniform(0.1, 0.3)
    return Material(
        hsv(hue, saturation, value),
        hsv(hue + 0.02, saturation, 0.5 * value),
        cell=(height * rng.uniform(1.8, 3.0), height),
        shift=0.5,
        joint=0.12 * height,
        variation=0.5,
    )


def planks(rng: Generator) -> Material:
    hue, value = rng.uniform(0.04, 0.11), rng.uniform(0.2, 0.6)
    saturation, width = rng.uniform(0.3, 0.6), rng.uniform(0.12, 0.35)
    return Material(
        hsv(hue, saturation, value),
        hsv(hue, saturation + 0.1, 0.45 * value),
        cell=(rng.uniform(1.2, 2.5), width),
        shift=0.37,
        joint=0.05 * width,
        variation=0.6,
        grain=(0.7, 5.0),
    )


def tiles(rng: Generator) -> Material:
    hue, value, size = rng.uniform(), rng.uniform(0.35, 0.7), rng.uniform(0.25, 0.6)
    saturation = rng.uniform(0.05, 0.35)
    return Material(
        hsv(hue, saturation, value),
        hsv(hue + 0.05, saturation, 0.65 * value),
        cell=(size, size),
        joint=0.03,
        variation=0.2,
        checker=rng.choice([0.0, 0.6, 1.1]),
    )


def cloth(rng: Generator) -> Material:
    """Draw a plain or striped cloth of any hue."""
    hue, value = rng.uniform(), rng.uniform(0.25, 0.8)
    saturation = rng.uniform(0.3, 0.7)
    striped = rng.random() < 0.5
    return Material(
        hsv(hue, saturation, value),
        hsv(hue + rng.uniform(-0.08, 0.08), saturation, 0.5 * value),
        cell=(PLAIN, rng.uniform(0.1, 0.3)) if striped else (PLAIN, PLAIN),
        checker=0.9 if striped else 0.0,
        grain=(1.5, 1.5),
    )


def grass(rng: Generator) -> Material:
    hue, value = rng.uniform(0.12, 0.28), rng.uniform(0.25, 0.45)
    earth = hsv(rng.uniform(0.06, 0.11), 0.5, 0.5 * value)
    return Material(hsv(hue, rng.uniform(0.4, 0.65), value), earth, grain=(0.7, 0.7))


def leaves(rng: Generator) -> Material:
    hue, value = rng.uniform(0.1, 0.32), rng.uniform(0.2, 0.4)
    return Material(
        hsv(hue, 0.65, 1.3 * value), hsv(hue + 0.05, 0.7, 0.25 * value), grain=(3.0, 3.0)
    )


def stone(rng: Generator) -> Material:
    hue, value = rng.uniform(0.05, 0.15), rng.uniform(0.35, 0.6)
    return Material(hsv(hue, 0.15, value), hsv(hue, 0.25, 0.4 * value), grain=(2.0, 2.0))


def noise_lattice(rng: Generator) -> Float[np.ndarray, "2 N N"]:
    """Draw two channels of numbers in [-1, 1]; the first row and column repeat at the end."""
    lattice = rng.uniform(-1, 1, (2, LATTICE, LATTICE))
    return np.pad(lattice, ((0, 0), (0, 1), (0, 1)), mode="wrap")


def fractal_noise(
    lattice: Float[Tensor, "2 N N"], uv: Float[Tensor, "2 R"], footprint: Float[Tensor, " R"]
) -> Float[Tensor, "2 R"]:
    """Sum value noise over the octaves that a pixel can resolve; lengths are the coarsest's."""
    octave = torch.arange(OCTAVES, device=uv.device)
    frequency = 2.0**octave
    # The lattices of the octaves are shifted so that their points do not coincide.
    point = uv * frequency[:, None, None] + 17.3 * octave[:, None, None]
    corner = point.floor()
    step = point - corner
    step = step * step * (3 - 2 * step)
    grid = (torch.remainder(corner, LATTICE) + step) * (2 / LATTICE) - 1
    noise = torch.nn.functional.grid_sample(
        lattice[None], grid.permute(0, 2, 1)[None], align_corners=True
    )[0]
    resolved = (2 - 2 * footprint * frequency[:, None]).clamp(0, 1)
    return (noise * (resolved * PERSISTENCE ** octave[:, None])).sum(1)


def cell_pattern(
    lattice: Float[Tensor, "2 N N"],
    uv: Float[Tensor, "2 R"],
    footprint: Float[Tensor, " R"],
    cell: Float[Tensor, "2 R"],
    shift: Float[Tensor, " R"],
    joint: Float[Tensor, " R"],
) -> tuple[Float[Tensor, " R"], Float[Tensor, " R"], Float[Tensor, " R"]]:
    """Evaluate a grid of cells: a random tone for each cell, a checkered tone, and joint coverage.

    Tones are in [-1, 1], and fade toward a cell's edge over the footprint against aliasing.
    """
    in_cells = uv / cell
    row = in_cells[1].floor()
    across = torch.stack((in_cells[0] + shift * row, in_cells[1]))
    corner = across.floor()
    to_edge = ((0.5 - (across - corner - 0.5).abs()) * cell).amin(0)
    fade = (2 * to_edge / footprint).clamp(0, 1) * (2 - footprint / cell.amin(0)).clamp(0, 1)
    index: Int[Tensor, "2 R"] = torch.remainder(corner, LATTICE).long()
    tone = lattice[0, index[0], index[1]]
    parity = 1 - 2 * torch.remainder(corner.sum(0), 2)
    covered = ((joint + footprint) / 2 - to_edge) / footprint
    covered = torch.minimum(covered.clamp(min=0), (joint / footprint).clamp(max=1))
    return tone * fade, parity * fade, covered


def albedo(
    lattice: Float[Tensor, "2 N N"],
    rows: Float[Tensor, "K R"],
    uv: Float[Tensor, "2 R"],
    footprint: Float[Tensor, " R"],
) -> Float[Tensor, "3 R"]:
    """Compute the linear color of each hit of a surface, `Material.row`, without its gloss."""
    base, accent, cell, (shift, joint, variation, checker), grain, _ = rows.split(
        (3, 3, 2, 4, 2, 2)
    )
    noise = fractal_noise(lattice, uv * grain, footprint * grain.amax(0))
    tone, parity, covered = cell_pattern(lattice, uv, footprint, cell, shift, joint)
    mix = (0.5 + 0.5 * noise[0]).clamp(0, 1)
    brightness = torch.exp(0.2 * noise[1] + variation * tone + checker * parity / 2)
    return (base + (accent - base) * mix) * brightness * (1 - 0.6 * covered)
