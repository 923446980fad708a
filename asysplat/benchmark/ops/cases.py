"""The operators at one size each: their inputs, their call and the matrix products in them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from asysplat.benchmark.products import Size, grid_attention_sizes, ssd_sizes
from asysplat.ops import grid_attention, selective_scan, ssd

STEPS = (1e-3, 1e-1)  # dt of an untrained network
KEPT = ("dt", "A", "D")  # always fp32

Tensors = dict[str, Tensor]


@dataclass(frozen=True)
class SSD:
    """A Mamba2 layer's scan, of one direction."""

    name: ClassVar[str] = "ssd"
    paths: ClassVar[tuple[str, ...]] = ("chunked", "cpu", "cuda")

    batch: int
    length: int
    heads: int
    head_width: int
    state: int

    @property
    def tokens(self) -> int:
        return self.batch * self.length

    def tensors(self) -> Tensors:
        """Inputs in float64."""
        draw = _Draw()
        sequence = (self.batch, self.length)
        return {
            "x": draw.normal(*sequence, self.heads, self.head_width),
            "dt": draw.steps(*sequence, self.heads),
            "A": -1 - 15 * draw.uniform(self.heads),
            "B": draw.normal(*sequence, self.state),
            "C": draw.normal(*sequence, self.state),
            "D": draw.normal(self.heads),
        }

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        return ssd(**tensors, backend=backend)

    def sizes(self) -> list[Size]:
        """Of its matrix products."""
        return ssd_sizes(self.batch, self.length, self.heads, self.head_width, self.state)

    def shortened(self, length: int) -> "SSD":
        """For the sequential loop."""
        return replace(self, length=min(length, self.length))


@dataclass(frozen=True)
class SelectiveScan:
    """A MambaVision layer's scan: each frame a sequence."""

    name: ClassVar[str] = "selective_scan"
    paths: ClassVar[tuple[str, ...]] = ("chunked", "cpu", "cuda")

    batch: int
    length: int
    channels: int
    state: int

    @property
    def tokens(self) -> int:
        return self.batch * self.length

    def tensors(self) -> Tensors:
        """Inputs in float64."""
        draw = _Draw()
        sequence = (self.batch, self.length)
        return {
            "x": draw.normal(*sequence, self.channels),
            "dt": draw.steps(*sequence, self.channels),
            "A": -torch.arange(1.0, self.state + 1, dtype=torch.float64).repeat(self.channels, 1),
            "B": draw.normal(*sequence, self.state),
            "C": draw.normal(*sequence, self.state),
            "D": draw.normal(self.channels),
        }

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        return selective_scan(**tensors, backend=backend)

    def sizes(self) -> list[Size]:
        """Its channels have states of their own: there is no matrix product."""
        return []

    def shortened(self, length: int) -> "SelectiveScan":
        """For the sequential loop."""
        return replace(self, length=min(length, self.length))


@dataclass(frozen=True)
class GridAttention:
    """Attention of one layer; grid 1 is full attention."""

    paths: ClassVar[tuple[str, ...]] = ("sdpa", "cpu", "cuda")

    batch: int
    views: int
    height: int
    width: int
    heads: int
    head_width: int
    grid: int

    @property
    def name(self) -> str:
        return f"grid_attention/{self.grid}"

    @property
    def tokens(self) -> int:
        return self.batch * self.views * self.height * self.width

    def tensors(self) -> Tensors:
        """Inputs in float64."""
        draw = _Draw()
        maps = (self.batch, self.views, self.height, self.width, self.heads, self.head_width)
        return {name: draw.normal(*maps) for name in ("q", "k", "v")}

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        return grid_attention(**tensors, grid=self.grid, backend=backend)

    def sizes(self) -> list[Size]:
        """Of its matrix products."""
        maps = (self.batch, self.views, self.height, self.width, self.heads, self.head_width)
        return grid_attention_sizes(*maps, self.grid)

    def shortened(self, length: int) -> None:
        """There is no sequential loop of it."""
        return None


Case = SSD | SelectiveScan | GridAttention


def find_cases(options: Mapping) -> list[tuple[Case, Case]]:
    """Each operator at its size, and the smaller one of its kind that errors are measured on."""
    exact = options["exact"]
    pairs = [
        (kind(**options[kind.name]), kind(**{**options[kind.name], **exact[kind.name]}))
        for kind in (SSD, SelectiveScan)
    ]
    attention = dict(options["grid_attention"])
    for grid in attention.pop("grids"):
        case = GridAttention(**attention, grid=grid)
        pairs.append((case, replace(case, **exact["grid_attention"])))
    return pairs


def typed(tensors: Tensors, dtype: torch.dtype, device: torch.device) -> Tensors:
    """The inputs in `dtype`, those KEPT in fp32; leaves that gradients are asked for."""
    return {
        name: tensor.to(device, torch.float32 if name in KEPT else dtype).requires_grad_()
        for name, tensor in tensors.items()
    }


class _Draw:
    """Random numbers in float64, the same for every case."""

    def __init__(self):
        self.generator = torch.Generator().manual_seed(0)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, dtype=torch.float64)

    def steps(self, *shape: int) -> Tensor:
        """Log-uniform between STEPS."""
        low, high = map(math.log, STEPS)
        return (low + (high - low) * self.uniform(*shape)).exp()
