"""Matrix products and convolutions by themselves: the least that a computation made of them takes.

Matrices are contiguous, whatever the layout was in the computation they stand for; images keep
their channels innermost where they had them so.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.utils._python_dispatch import TorchDispatchMode

from asysplat.benchmark.timing import Timer, seconds_of
from asysplat.evaluation.cost import true_flops
from asysplat.ops.ssd.chunked import CHUNK

aten = torch.ops.aten
CALLS = {call.default for call in (aten.mm, aten.addmm, aten.bmm, aten.baddbmm, aten.convolution)}
# Numbers of one operand or result: few enough to stay in a cache, enough to fill a GPU.
LARGEST = {"cpu": 2**22, "cuda": 2**26}
MOST_CALLS = 16  # of a product that are timed together

Size = tuple[int, int, int, int]  # [m, k] x [k, n], as often as the first says


@dataclass(frozen=True)
class Operand:
    """What a tensor is but for its values."""

    shape: tuple[int, ...]
    dtype: torch.dtype
    channels_last: bool = False

    def make(self, device: torch.device | str) -> Tensor:
        values = torch.randn(self.shape, dtype=self.dtype, device=device)
        if self.channels_last:
            return values.contiguous(memory_format=torch.channels_last)
        return values


@dataclass(frozen=True)
class Product:
    """
    Args:
        function: of torch.ops.aten.
        arguments: its positional ones; lists as tuples.
    """

    function: OpOverload
    arguments: tuple[Operand | Any, ...]

    def __str__(self) -> str:
        operands = [value for value in self.arguments if isinstance(value, Operand)]
        shapes = " ".join("x".join(map(str, operand.shape)) for operand in operands)
        dtype = str(operands[0].dtype).removeprefix("torch.")
        return f"{self.function.overloadpacket.__name__} {shapes} {dtype}"

    def prepare(self, device: torch.device | str) -> Callable[[], Tensor]:
        """The call, with operands of its own."""
        arguments = [
            value.make(device) if isinstance(value, Operand) else value for value in self.arguments
        ]
        return lambda: self.function(*arguments)

    def flops(self) -> int:
        return true_flops(self.prepare("meta"))

    def seconds(self, count: int, device: torch.device) -> float:
        """Of one of `count` calls."""
        call, calls = self.prepare(device), min(count, MOST_CALLS)
        call()

        def run() -> None:
            for _ in range(calls):
                call()

        return seconds_of(run, device) / calls


class RecordProducts(TorchDispatchMode):
    """Counts the products of everything that torch is asked for meanwhile, by `label`."""

    def __init__(self, label: str):
        super().__init__()
        self.label = label
        self.counts: dict[str, Counter[Product]] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.counts.setdefault(self.label, Counter()).update(_products_of_call(func, args))
        return func(*args, **(kwargs or {}))


def _products_of_call(func: OpOverload, args: tuple) -> Mapping[Product, int]:
    """Operators that torch takes as one call come apart into the products in them."""
    if func in CALLS:
        return {Product(func, tuple(_without_values(value) for value in args)): 1}
    name = func._schema.name
    named = {
        argument.name: value for argument, value in zip(func._schema.arguments, args, strict=False)
    }
    if name.startswith("aten::_scaled_dot_product"):
        q, k, v = args[:3]
        sizes = attention_sizes(q.shape[:-2].numel(), q.shape[-2], k.shape[-2], q.shape[-1])
        return products(sizes, v.dtype, v.device)
    if name == "asysplat::ssd":
        x, B = named["x"], named["B"]
        return products(ssd_sizes(*x.shape, B.shape[-1]), x.dtype, x.device)
    if name == "asysplat::grid_attention":
        q = named["q"]
        return products(grid_attention_sizes(*q.shape, named["grid"]), q.dtype, q.device)
    return {}


def _without_values(value: Any) -> Operand | Any:
    if isinstance(value, Tensor):
        innermost = value.ndim == 4 and value.is_contiguous(memory_format=torch.channels_last)
        return Operand(tuple(value.shape), value.dtype, innermost and not value.is_contiguous())
    return tuple(value) if isinstance(value, list) else value


def ssd_sizes(batch: int, length: int, heads: int, head_width: int, state: int) -> list[Size]:
    """Of the chunked form, the last chunk whole: C B^T, scores x inputs, the state's update and
    its reading."""
    chunks, inner = batch * -(-length // CHUNK), heads * head_width
    return [
        (chunks, CHUNK, state, CHUNK),
        (chunks * heads, CHUNK, CHUNK, head_width),
        (chunks, state, CHUNK, inner),
        (chunks, CHUNK, state, inner),
    ]


def attention_sizes(heads: int, queries: int, keys: int, head_width: int) -> list[Size]:
    """Scores, and their product with the values."""
    return [(heads, queries, head_width, keys), (heads, queries, keys, head_width)]


def grid_attention_sizes(
    batch: int, views: int, height: int, width: int, heads: int, head_width: int, grid: int
) -> list[Size]:
    """Each grid place by itself, maps padded to multiples of the grid."""
    tokens = views * -(-height // grid) * -(-width // grid)
    return attention_sizes(batch * grid**2 * heads, tokens, tokens, head_width)


def with_gradients(sizes: Iterable[Size]) -> list[Size]:
    """The products, and those that give the gradients of both operands."""
    return [size for b, m, k, n in sizes for size in ((b, m, k, n), (b, m, n, k), (b, k, m, n))]


def products(sizes: Iterable[Size], dtype: torch.dtype, device: torch.device) -> Counter[Product]:
    """Calls that do these products, each with operands and a result of at most LARGEST numbers."""
    counts: Counter[Product] = Counter()
    largest = LARGEST[device.type]
    for batch, m, k, n in sizes:
        rows = _largest_divisor(m, largest // max(k, n))
        entries = _largest_divisor(batch, largest // max(rows * k, k * n, rows * n))
        left, right = (rows, k), (k, n)
        function = aten.mm.default
        if entries > 1:
            left, right = (entries, *left), (entries, *right)
            function = aten.bmm.default
        product = Product(function, (Operand(left, dtype), Operand(right, dtype)))
        counts[product] += batch // entries * (m // rows)
    return counts


def _largest_divisor(number: int, most: int) -> int:
    return next(d for d in range(max(1, min(number, most)), 0, -1) if number % d == 0)


def sum_of_products(
    counts: Mapping[Product, int], seconds: Mapping[Hashable, list[float]]
) -> list[float]:
    """Seconds of all of them, in each round."""
    each = [[count * value for value in seconds[product]] for product, count in counts.items()]
    return [sum(values) for values in zip(*each, strict=True)]


def product_timers(counts: Mapping[Product, int], device: torch.device) -> list[Timer]:
    """Each product's time, under itself."""

    def timer(product: Product, count: int) -> Timer:
        return lambda: {product: product.seconds(count, device)}

    return [timer(product, count) for product, count in counts.items()]
