"""The operators at one size each: their inputs, their call and the matrix products in them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from asysplat import ops
from asysplat.benchmark.options import PRECISIONS
from asysplat.benchmark.products import Size, grid_attention_sizes, ssd_sizes
from asysplat.benchmark.scenes import random_numbers

STEPS = (1e-3, 1e-1)  # dt of an untrained network
SCANS = ("ssd", "selective_scan")
TOKENS = ("batch", "length", "views", "height", "width")  # sizes whose product is their number
# The shape of each input, in the order that they are drawn.
SHAPES = {
    "ssd": {  # a Mamba2 layer's scan, of one direction
        "x": "batch length heads head_dim",
        "dt": "batch length heads",
        "A": "heads",
        "B": "batch length state",
        "C": "batch length state",
        "D": "heads",
    },
    "selective_scan": {  # a MambaVision layer's scan: each frame a sequence
        "x": "batch length channels",
        "dt": "batch length channels",
        "A": "channels state",
        "B": "batch length state",
        "C": "batch length state",
        "D": "channels",
    },
    # One attention layer; grid 1 is full attention.
    "grid_attention": dict.fromkeys("qkv", "batch views height width heads head_dim"),
}
PRODUCTS = {"ssd": ssd_sizes, "grid_attention": grid_attention_sizes}

Tensors = dict[str, Tensor]


@dataclass(frozen=True)
class Case:
    """An operator at one size."""

    operator: str  # of `asysplat.ops`
    sizes: Mapping[str, int]  # of its inputs, as SHAPES names them, and the grid of an attention
    exact: Mapping[str, int] = field(default_factory=dict)  # sizes that differ for errors

    differentiable = True
    precisions = tuple(PRECISIONS)  # in which it computes

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
        return math.prod(size for side, size in self.sizes.items() if side in TOKENS)

    @property
    def small(self) -> "Case":
        """Return the case of its kind that errors are measured on."""
        return self.resized(**self.exact)

    def resized(self, **sizes: int) -> "Case":
        return replace(self, sizes={**self.sizes, **sizes})

    def tensors(self) -> Tensors:
        """Make inputs in float64; the same numbers at every call."""
        uniform, normal = random_numbers(0)
        tensors = {}
        for name, sides in SHAPES[self.operator].items():
            shape = [self.sizes[side] for side in sides.split()]
            if name == "dt":  # log-uniform
                low, high = map(math.log, STEPS)
                tensors[name] = (low + (high - low) * uniform(shape)).exp()
            elif name != "A":
                tensors[name] = normal(shape)
            elif self.operator == "ssd":
                tensors[name] = -1 - 15 * uniform(shape)
            else:
                states = torch.arange(1.0, self.sizes["state"] + 1, dtype=torch.float64)
                tensors[name] = -states.repeat(self.sizes["channels"], 1)
        return tensors

    def run(self, tensors: Tensors, backend: str) -> Tensor:
        return getattr(ops, self.operator)(**tensors, **self.options, backend=backend)

    def products(self) -> list[Size]:
        """List its matrix products; a selective scan's channels have states of their own."""
        return PRODUCTS[self.operator](**self.sizes) if self.operator in PRODUCTS else []


def find_cases(options: Mapping[str, Any]) -> list[Case]:
    """Make each operator at its size; attention with each of its grids."""
    attention = dict(options["grid_attention"])
    grids = attention.pop("grids")
    sizes = [(scan, options[scan]) for scan in SCANS]
    sizes += [("grid_attention", attention | {"grid": grid}) for grid in grids]
    return [Case(operator, size, options["exact"][operator]) for operator, size in sizes]
