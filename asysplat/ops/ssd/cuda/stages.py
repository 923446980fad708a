"""The stages of SSD and of its gradients, one after the other."""

from typing import NamedTuple

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.cuda.scans import FUSED, INTERPRETED, check_size
from asysplat.ops.ssd.cuda.decays import ROWS, sum_decays
from asysplat.ops.ssd.cuda.head_gradients import head_gradients
from asysplat.ops.ssd.cuda.output import multiply_vectors, output_chunk
from asysplat.ops.ssd.cuda.states import pass_on
from asysplat.ops.ssd.cuda.vector_gradients import score_gradients, vector_gradients

CHUNK = 16 if INTERPRETED else 64  # tokens
BLOCK = 64  # columns of a state in a program
HEADS = 8  # in a program that sums decays
LAUNCH = {"num_warps": 8, "num_stages": 2, **FUSED}  # with fewer warps, fp32 products spill
MOST_WIDTH, MOST_STATE = 128, 256
# As what a product's factors are rounded: fp16 has not the range of a state, TF32 has all its bits.
PRODUCTS = {
    torch.float32: {"DOT": tl.float32, "PRECISION": "ieee"},
    torch.bfloat16: {"DOT": tl.bfloat16, "PRECISION": "ieee"},
    torch.float16: {"DOT": tl.float32, "PRECISION": "tf32"},
}


def carried_shape(x: Float[Tensor, "B L H P"], B: Float[Tensor, "B L N"]) -> tuple[int]:
    """Nothing but the inputs."""
    return (0,)


def forward(
    x: Float[Tensor, "B L H P"],
    dt: Float[Tensor, "B L H"],
    A: Float[Tensor, "H"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "H"],
    reverse: bool,
    keep: bool,
) -> tuple[Float[Tensor, "B L H P"], Float[Tensor, "0"]]:
    """y, and an empty tensor, which is all there is to keep; see `asysplat.ops.ssd`.

    Raises:
        InputError: a head width or a state size that is no power of two from 16 to 128 or 256.
    """
    check_size("ssd", "head width", x.shape[-1], MOST_WIDTH)
    check_size("ssd", "state size", B.shape[-1], MOST_STATE)
    x, dt, A, B, C, D = (tensor.contiguous() for tensor in (x, dt, A, B, C, D))
    y = torch.empty_like(x)
    with torch.cuda.device_of(x):
        sizes = _Sizes.of(x, B, reverse)
        decays = _decays(sizes, dt, A)
        states = _states(sizes, x, B, decays, gradient=False)
        output_chunk[(sizes.chunks * sizes.heads, sizes.batch)](
            *(x, C, D, decays, _scores(sizes, B, C), states, y),
            *sizes.counts,
            **sizes.tile,
        )
    return y, dt.new_empty(carried_shape(x, B))


def backward(
    grad_y: Float[Tensor, "B L H P"],
    x: Float[Tensor, "B L H P"],
    dt: Float[Tensor, "B L H"],
    A: Float[Tensor, "H"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "H"],
    carried: Float[Tensor, "0"],
    reverse: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of x, dt, A, B, C and D."""
    inputs = (grad_y, x, dt, A, B, C, D)
    grad_y, x, dt, A, B, C, D = (tensor.contiguous() for tensor in inputs)
    grads = [torch.empty_like(tensor) for tensor in (x, dt, B, C)]
    grad_x, grad_dt, grad_B, grad_C = grads
    with torch.cuda.device_of(x):
        sizes = _Sizes.of(x, B, reverse)
        parts = (sizes.batch, sizes.chunks, sizes.heads)
        grad_A, grad_D = dt.new_empty(parts), dt.new_empty(parts)
        decays = _decays(sizes, dt, A)
        states = _states(sizes, x, B, decays, gradient=False)
        grad_states = _states(sizes, grad_y, C, decays, gradient=True)
        head_gradients[(sizes.chunks * sizes.heads, sizes.batch)](
            *(grad_y, x, A, B, C, D, decays, _scores(sizes, B, C), states, grad_states),
            *(grad_x, grad_dt, grad_A, grad_D),
            *sizes.counts,
            **sizes.tile,
        )
        grad_scores = dt.new_empty(sizes.squares)
        tile = {name: size for name, size in sizes.tile.items() if name not in ("STATE", "BLOCK")}
        score_gradients[(sizes.chunks, sizes.batch)](
            *(grad_y, x, decays, grad_scores), *sizes.counts, **tile
        )
        grid = (sizes.blocks, sizes.chunks, sizes.batch)
        for of_B, arrays in (
            (True, (x, C, decays, grad_scores, grad_states, grad_B)),
            (False, (grad_y, B, decays, grad_scores, states, grad_C)),
        ):
            vector_gradients[grid](*arrays, *sizes.counts, OF_B=of_B, **sizes.tile)
    return grad_x, grad_dt, grad_A.sum((0, 1)), grad_B, grad_C, grad_D.sum((0, 1))


class _Sizes(NamedTuple):
    """What the kernels are told."""

    batch: int
    length: int
    heads: int
    width: int
    state: int
    dtype: torch.dtype
    reverse: bool

    @classmethod
    def of(cls, x: Tensor, B: Tensor, reverse: bool) -> "_Sizes":
        return cls(*x.shape, B.shape[-1], x.dtype, reverse)

    @property
    def chunks(self) -> int:
        return -(-self.length // CHUNK)

    @property
    def counts(self) -> tuple[int, int, int]:
        return self.length, self.heads, self.chunks

    @property
    def squares(self) -> tuple[int, int, int, int]:
        return self.batch, self.chunks, CHUNK, CHUNK

    @property
    def block(self) -> int:
        return min(BLOCK, self.state)

    @property
    def blocks(self) -> int:
        return self.state // self.block

    @property
    def tile(self) -> dict:
        return {
            "REVERSE": self.reverse,
            "WIDTH": self.width,
            "STATE": self.state,
            "BLOCK": self.block,
            "CHUNK": CHUNK,
            **PRODUCTS[self.dtype],
            **LAUNCH,
        }


def _decays(sizes: _Sizes, dt: Tensor, A: Tensor) -> Tensor:
    """See `sum_decays`."""
    shape = (sizes.batch, sizes.heads, ROWS.value, sizes.chunks * CHUNK)
    decays = dt.new_empty(shape)
    sum_decays[(sizes.chunks, -(-sizes.heads // HEADS), sizes.batch)](
        *(dt, A, decays, sizes.length, sizes.heads),
        REVERSE=sizes.reverse,
        CHUNK=CHUNK,
        BLOCK=HEADS,
        **FUSED,
    )
    return decays


def _states(
    sizes: _Sizes, values: Tensor, vectors: Tensor, decays: Tensor, gradient: bool
) -> Tensor:
    """Before each chunk, or with `gradient` the gradient of the state after it."""
    shape = (sizes.batch, sizes.chunks, sizes.heads, sizes.width, sizes.state)
    states = decays.new_empty(shape)
    pass_on[(sizes.blocks, sizes.heads, sizes.batch)](
        *(values, vectors, decays, states), *sizes.counts, GRADIENT=gradient, **sizes.tile
    )
    return states


def _scores(sizes: _Sizes, B: Tensor, C: Tensor) -> Tensor:
    """See `multiply_vectors`."""
    scores = torch.empty(sizes.squares, dtype=torch.float32, device=B.device)
    tile = {name: size for name, size in sizes.tile.items() if name != "WIDTH"}
    multiply_vectors[(sizes.chunks, sizes.batch)](
        *(B, C, scores, sizes.length, sizes.chunks), **tile
    )
    return scores
