"""Random numbers on the device of their generator."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor


def random_permutation(count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """Sample a permutation on the generator's device."""
    return torch.randperm(count, generator=generator, device=generator.device)


def random_order(count: int, generator: torch.Generator) -> Iterator[int]:
    """Yield indices in a random order, without end; all are used before one is used again."""
    while True:
        yield from random_permutation(count, generator).tolist()


def random_normal(
    rows: int, columns: int, generator: torch.Generator
) -> Float[Tensor, "rows columns"]:
    """Sample standard normal numbers on the generator's device."""
    return torch.randn(rows, columns, generator=generator, device=generator.device)
