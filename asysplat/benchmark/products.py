"""Matrix products and convolutions by themselves: a lower bound of a computation made of them.

Matrices are contiguous, whatever their strides in the computation they stand for; images keep
channels innermost where they had them so.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.benchmark import Timer

from asysplat.ops.ssd.chunked import CHUNK

aten = torch.ops.aten
CALLS = {call.default for call in (aten.mm, aten.addmm, aten.bmm, aten.baddbmm, aten.convolution)}
# Numbers of one operand or result: few enough to stay in a cache, enough to fill a GPU.
MAX_NUMBERS = {"cpu": 2**22, "cuda": 2**26}
MAX_CALLS = 16  # of a product that are timed together

Size = tuple[int, int, int, int]  # count, m, k, n: so many products [m, k] x [k, n]


@dataclass(frozen=True)
class Operand:
    """The shape, type and layout of a tensor."""

    shape: tuple[int, ...]
    dtype: torch.dtype
    memory_format: torch.memory_format = torch.contiguous_format

    def make(self, device: torch.device | str) -> Tensor:
        values = torch.randn(self.shape, dtype=self.dtype, device=device)
        return values.contiguous(memory_format=self.memory_format)


@dataclass(frozen=True)
class Product:
    """One call of torch."""

    function: OpOverload  # of torch.ops.aten
    arguments: tuple[Operand | Any, ...]  # its positional ones; lists as tuples

    def prepare(self, device: torch.device | str) -> Callable[[], Tensor]:
        """Make operands; return the call of the function on them."""
        arguments = [
            value.make(device) if isinstance(value, Operand) else value for value in self.arguments
        ]
        return lambda: self.function(*arguments)


Counts = Mapping[Product, int]


class RecordProducts(TorchDispatchMode):
    """Counts the products of all torch operators that are called in its context, by `label()`."""

    def __init__(self, label: Callable[[], str]):
        super().__init__()
        self.label = label
        self.counts: dict[str, Counter[Product]] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.counts.setdefault(self.label(), Counter()).update(_products_of_call(func, args))
        return func(*args, **(kwargs or {}))


def _products_of_call(func: OpOverload, args: tuple) -> Counts:
    """Count the products of a call; an operator that is one call to torch has several."""
    if func in CALLS:
        return {Product(func, tuple(map(_without_values, args))): 1}
    if func._schema.name.startswith("aten::_scaled_dot_product"):
        q, k, v = args[:3]
        sizes = attention_sizes(q.shape[:-2].numel(), q.shape[-2], k.shape[-2], q.shape[-1])
        return products(sizes, v.dtype, v.device)
    if func._schema.name == "asysplat::ssd":
        names = [argument.name for argument in func._schema.arguments]
        x, B = (args[names.index(name)] for name in "xB")
        return products(ssd_sizes(*x.shape, B.shape[-1]), x.dtype, x.device)
    return {}


def _without_values(value: Any) -> Operand | Any:
    if not isinstance(value, Tensor):
        return tuple(value) if isinstance(value, list) else value
    innermost = value.ndim == 4 and value.is_contiguous(memory_format=torch.channels_last)
    channels_last = innermost and not value.is_contiguous()
    layout = torch.channels_last if channels_last else torch.contiguous_format
    return Operand(tuple(value.shape), value.dtype, layout)


def ssd_sizes(batch: int, length: int, heads: int, head_dim: int, state: int) -> list[Size]:
    """List the products of the chunked form, the last chunk padded to a whole one.

    C B^T, scores x inputs, the state's update and its reading.
    """
    chunks, inner = batch * -(-length // CHUNK), heads * head_dim
    return [
        (chunks, CHUNK, state, CHUNK),
        (chunks * heads, CHUNK, CHUNK, head_dim),
        (chunks, state, CHUNK, inner),
        (chunks, CHUNK, state, inner),
    ]


def attention_sizes(heads: int, queries: int, keys: int, head_dim: int) -> list[Size]:
    """List the scores, and their product with the values."""
    return [(heads, queries, head_dim, keys), (heads, queries, keys, head_dim)]


def grid_attention_sizes(
    batch: int, views: int, height: int, width: int, heads: int, head_dim: int, grid: int
) -> list[Size]:
    """List the products of each place of the grid, maps padded to whole grids."""
    tokens = views * -(-height // grid) * -(-width // grid)
    return attention_sizes(batch * grid**2 * heads, tokens, tokens, head_dim)


def with_gradients(sizes: Iterable[Size]) -> list[Size]:
    """Add to each product the two that give the gradients of its operands."""
    return [size for b, m, k, n in sizes for size in ((b, m, k, n), (b, m, n, k), (b, k, m, n))]


def products(sizes: Iterable[Size], dtype: torch.dtype, device: torch.device) -> Counter[Product]:
    """Split products into calls whose operands and results have at most MAX_NUMBERS each."""
    counts: Counter[Product] = Counter()
    limit = MAX_NUMBERS[device.type]
    for batch, m, k, n in sizes:
        rows = _largest_divisor(m, limit // max(k, n))
        entries = _largest_divisor(batch, limit // max(rows * k, k * n, rows * n))
        leading = (entries,) if entries > 1 else ()
        operands = Operand((*leading, rows, k), dtype), Operand((*leading, k, n), dtype)
        function = aten.bmm.default if leading else aten.mm.default
        counts[Product(function, operands)] += batch // entries * (m // rows)
    return counts


def _largest_divisor(number: int, limit: int) -> int:
    return next(d for d in range(max(1, min(number, limit)), 0, -1) if number % d == 0)


def time_products(groups: Mapping[Hashable, Counts], device: torch.device) -> dict[Hashable, float]:
    """Time each product once; return the seconds of each group."""
    union = reduce(or_, map(Counter, groups.values()))  # with the greatest count of any group
    seconds = {}
    for product, count in union.items():
        scope = {"call": product.prepare(device)}
        timer = Timer("call()", globals=scope, num_threads=torch.get_num_threads())
        seconds[product] = timer.timeit(min(count, MAX_CALLS)).mean
    return {
        name: sum((count * seconds[product] for product, count in counts.items()), 0.0)
        for name, counts in groups.items()
    }
