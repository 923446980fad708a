"""The operators at one size each: their inputs, their call and the matrix products in them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from asysplat import ops
from asysplat.benchmark.products import Size, grid_attention_sizes, ssd_sizes

STEPS = (1e-3, 1e-1)  # dt of an untrained network
SCANS = ("ssd", "selective_scan")

Tensors = dict[str, Tensor]
Draw = Callable[..., Tensor]  # of a shape, in float64


@dataclass(frozen=True)
class Case:
    """An operator at one size.

    Args:
        operator: of `asysplat.ops`.
        sizes: of its inputs, as its function in INPUTS names them.
    """

    operator: str
    sizes: Mapping[str, int]

    @property
    def name(self) -> str:
        return "/".join([self.operator, *map(str, self.options.values())])

    @property
    def options(self) -> dict[str, int]:
        """Return the arguments of the operator besides tensors."""
        return {"grid": self.sizes["grid"]} if "grid" in self.sizes else {}

    @property
    def backends(self) -> tuple[str, ...]:
        return ("chunked" if self.operator in SCANS else "sdpa", "cpu", "cuda")

    @property
    def tokens(self) -> int:
        sides = (
            ("batch", "length") if self.operator in SCANS else ("batch", "views", "height", "width")
        )
        return math.prod(self.sizes[side] for side in sides)

    def resized(self, **sizes: int) -> "Case":
        return Case(self.operator, {**self.sizes, **sizes})

    def tensors(self) -> Tensors:
        """Make inputs in float64; the same numbers at every call."""
        generator = torch.Generator().manual_seed(0)

        def normal(*shape: int) -> Tensor:
            return torch.randn(shape, generator=generator, dtype=torch.float64)

        def uniform(*shape: int) -> Tensor:
            return torch.rand(shape, generator=generator, dtype=torch.float64)

        return INPUTS[self.operator](normal, uniform, **self.sizes)

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        return getattr(ops, self.operator)(**tensors, **self.options, backend=backend)

    def products(self) -> list[Size]:
        """List its matrix products; a selective scan's channels have states of their own."""
        return PRODUCTS[self.operator](**self.sizes) if self.operator in PRODUCTS else []


def _ssd(
    normal: Draw, uniform: Draw, batch: int, length: int, heads: int, head_dim: int, state: int
) -> Tensors:
    """Make inputs of a Mamba2 layer's scan, of one direction."""
    return {
        "x": normal(batch, length, heads, head_dim),
        "dt": _steps(uniform(batch, length, heads)),
        "A": -1 - 15 * uniform(heads),
        "B": normal(batch, length, state),
        "C": normal(batch, length, state),
        "D": normal(heads),
    }


def _selective_scan(
    normal: Draw, uniform: Draw, batch: int, length: int, channels: int, state: int
) -> Tensors:
    """Make inputs of a MambaVision layer's scan: each frame a sequence."""
    return {
        "x": normal(batch, length, channels),
        "dt": _steps(uniform(batch, length, channels)),
        "A": -torch.arange(1.0, state + 1, dtype=torch.float64).repeat(channels, 1),
        "B": normal(batch, length, state),
        "C": normal(batch, length, state),
        "D": normal(channels),
    }


def _grid_attention(
    normal: Draw, uniform: Draw, *, heads: int, head_dim: int, **maps: int
) -> Tensors:
    """Make inputs of one attention layer; grid 1 is full attention."""
    shape = (*(maps[side] for side in ("batch", "views", "height", "width")), heads, head_dim)
    return {name: normal(*shape) for name in ("q", "k", "v")}


def _steps(uniform: Tensor) -> Tensor:
    """Turn uniform numbers into log-uniform ones between STEPS."""
    low, high = map(math.log, STEPS)
    return (low + (high - low) * uniform).exp()


INPUTS = {"ssd": _ssd, "selective_scan": _selective_scan, "grid_attention": _grid_attention}
PRODUCTS = {"ssd": ssd_sizes, "grid_attention": grid_attention_sizes}


def find_cases(options: Mapping[str, Any]) -> list[tuple[Case, Case]]:
    """Make each operator at its size, and the smaller one that its errors are measured on."""
    cases = [Case(scan, options[scan]) for scan in SCANS]
    attention = dict(options["grid_attention"])
    grids = attention.pop("grids")
    cases += [Case("grid_attention", {**attention, "grid": grid}) for grid in grids]
    return [(case, case.resized(**options["exact"][case.operator])) for case in cases]
