"""SSD for GPUs (Triton): matrix products within chunks, the state passed on between them.

Dao and Gu 2024, Section 6. Log decays are differences of sums from the chunk's start, each kept in
two fp32 numbers, to 48 bits; every exponent is <= 0. The backward pass needs only the inputs.
"""

from typing import Any, NamedTuple

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED
from asysplat.ops.scan import ScanInputs
from asysplat.ops.ssd.cuda.kernels import (
    ROWS,
    forward_chunk,
    head_gradients,
    pass_states,
    projection_gradients,
    score_chunk,
    score_gradients,
    sum_decays,
)
from asysplat.ops.ssd.reference import CHUNK

# Tokens of a chunk: few in the slow interpreter, so that short sequences have several chunks.
TOKENS = 16 if INTERPRETED else CHUNK
BLOCK = 64  # columns of a state in a program
HEADS = 8  # heads in a program of `sum_decays`
LAUNCH = {"num_warps": 8, "num_stages": 2, **FUSED}
# Types of a product's factors, and its precisions. fp16 lacks the range of a state.
BFLOAT16 = {"DOT": tl.bfloat16, "PRECISION": "ieee"}
EXACT = {"DOT": tl.float32, "PRECISION": "ieee"}
# Types in which states are stored: those of a product's factors, to which it rounds them anyway.
STATES = {tl.bfloat16: torch.bfloat16, tl.float32: torch.float32}
# A sum of three TF32 products is as precise as EXACT and several times as fast. It is used only on
# Hopper, which reads the factors from shared memory: elsewhere they do not fit into registers. And
# only for factors of at least this size: of smaller ones, Triton 3.6 reads past the end.
EXACT_BY_TF32 = {"DOT": tl.float32, "PRECISION": "tf32x3"}
HOPPER = (9, 0)  # compute capability
TF32_HEAD_DIM, TF32_STATE = 64, 64  # head_dim, and smallest state size


def saved_state_shape(x: Float[Tensor, "B L H P"], B: Float[Tensor, "B L N"]) -> tuple[int]:
    """Return (0,): the backward pass needs nothing but the inputs."""
    return (0,)


def forward(
    inputs: ScanInputs, reverse: bool, keep: bool
) -> tuple[Float[Tensor, "B L H P"], Float[Tensor, "0"]]:
    """Return y and an empty saved state; see `asysplat.ops.scan`."""
    x, dt, A, B, C, D = (tensor.contiguous() for tensor in inputs)
    y = torch.empty_like(x)
    with torch.cuda.device_of(x):
        sizes = _Sizes(*x.shape, B.shape[-1], reverse, *_choose_products(x, B))
        decays = _compute_decays(sizes, dt, A)
        scores = _compute_scores(sizes, B, C)
        states = _compute_states(sizes, x, B, decays, gradient=False)
        forward_chunk[(sizes.chunks * sizes.heads, sizes.batch)](
            x, C, D, decays, scores, states, y, **sizes.launch_kwargs(forward_chunk)
        )
    return y, dt.new_empty(saved_state_shape(x, B))


def backward(
    grad_output: Float[Tensor, "B L H P"],
    inputs: ScanInputs,
    saved_state: Float[Tensor, "0"],
    reverse: bool,
) -> ScanInputs:
    """Return the gradients of the inputs; see `asysplat.ops.scan`."""
    x, dt, A, B, C, D = (tensor.contiguous() for tensor in inputs)
    grad_output = grad_output.contiguous()
    with torch.cuda.device_of(x):
        sizes = _Sizes(*x.shape, B.shape[-1], reverse, *_choose_products(x, B))
        parts = (sizes.batch, sizes.chunks, sizes.heads)
        grads = ScanInputs(
            x=torch.empty_like(x),
            dt=torch.empty_like(dt),
            A=dt.new_empty(parts),
            B=torch.empty_like(B),
            C=torch.empty_like(C),
            D=dt.new_empty(parts),
        )
        decays, scores = _compute_decays(sizes, dt, A), _compute_scores(sizes, B, C)
        states = _compute_states(sizes, x, B, decays, gradient=False)
        grad_states = _compute_states(sizes, grad_output, C, decays, gradient=True)
        head_gradients[(sizes.chunks * sizes.heads, sizes.batch)](
            *(grad_output, x, A, B, C, D),
            decays=decays,
            scores=scores,
            states=states,
            grad_states=grad_states,
            grad_x=grads.x,
            grad_dt=grads.dt,
            grad_A=grads.A,
            grad_D=grads.D,
            **sizes.launch_kwargs(head_gradients),
        )
        grad_scores = torch.empty_like(scores)
        score_gradients[(sizes.chunks, sizes.batch)](
            grad_output, x, decays, grad_scores, **sizes.launch_kwargs(score_gradients)
        )
        launch = projection_gradients[(sizes.blocks, sizes.chunks, sizes.batch)]
        options = sizes.launch_kwargs(projection_gradients)
        launch(x, C, decays, grad_scores, grad_states, grads.B, OF_B=True, **options)
        launch(grad_output, B, decays, grad_scores, states, grads.C, OF_B=False, **options)
    return grads._replace(A=grads.A.sum((0, 1)), D=grads.D.sum((0, 1)))


class _Sizes(NamedTuple):
    """The sizes of a scan, its direction, and the options of its products."""

    batch: int
    length: int
    heads: int
    head_dim: int
    state: int
    reverse: bool
    tokens: int  # tokens of a chunk
    products: dict[str, Any]  # type of a product's factors, and its precision

    @property
    def chunks(self) -> int:
        return -(-self.length // self.tokens)

    @property
    def block(self) -> int:
        return min(BLOCK, self.state)

    @property
    def blocks(self) -> int:
        return self.state // self.block

    def launch_kwargs(self, kernel: Any) -> dict[str, Any]:
        """Return the keyword arguments of a launch: what the kernel takes of these, and LAUNCH."""
        sizes = {
            "length": self.length,
            "heads": self.heads,
            "chunks": self.chunks,
            "REVERSE": self.reverse,
            "HEAD_DIM": self.head_dim,
            "STATE": self.state,
            "BLOCK": self.block,
            "CHUNK": self.tokens,
            **self.products,
        }
        return {name: size for name, size in sizes.items() if name in kernel.arg_names} | LAUNCH


def _choose_products(x: Tensor, B: Tensor) -> tuple[int, dict[str, Any]]:
    """Return the tokens of a chunk, and the type and precision of its products."""
    if x.dtype == torch.bfloat16:
        return TOKENS, BFLOAT16
    sizes_fit = x.shape[-1] == TF32_HEAD_DIM and B.shape[-1] >= TF32_STATE
    if sizes_fit and _compute_capability(x) == HOPPER:
        return TOKENS, EXACT_BY_TF32
    # Exact products of chunks of TOKENS would not fit into registers.
    return max(16, TOKENS // 2), EXACT


def _compute_capability(x: Tensor) -> tuple[int, int]:
    """Return that of the tensor's GPU; (0, 0) if it has none."""
    return torch.cuda.get_device_capability(x.device) if x.is_cuda else (0, 0)


def _compute_decays(sizes: _Sizes, dt: Tensor, A: Tensor) -> Float[Tensor, "B H rows positions"]:
    """Run `sum_decays`."""
    positions = sizes.chunks * sizes.tokens
    decays = dt.new_empty(sizes.batch, sizes.heads, ROWS.value, positions)
    sum_decays[(sizes.chunks, -(-sizes.heads // HEADS), sizes.batch)](
        *(dt, A, decays, sizes.length, sizes.heads),
        REVERSE=sizes.reverse,
        CHUNK=sizes.tokens,
        HEADS=HEADS,
        **FUSED,
    )
    return decays


def _compute_states(
    sizes: _Sizes, values: Tensor, projections: Tensor, decays: Tensor, gradient: bool
) -> Float[Tensor, "B chunks H P N"]:
    """Return the state before each chunk, or with `gradient` the gradient of the state after it."""
    shape = (sizes.batch, sizes.chunks, sizes.heads, sizes.head_dim, sizes.state)
    states = values.new_empty(shape, dtype=STATES[sizes.products["DOT"]])
    options = sizes.launch_kwargs(pass_states)
    if options["DOT"] == tl.float32:
        options |= EXACT  # TF32 is slower for a single product that waits for the chunk before
    pass_states[(sizes.blocks, sizes.heads, sizes.batch)](
        values, projections, decays, states, GRADIENT=gradient, **options
    )
    return states


def _compute_scores(sizes: _Sizes, B: Tensor, C: Tensor) -> Float[Tensor, "B chunks t s"]:
    """Run `score_chunk`."""
    shape = (sizes.batch, sizes.chunks, sizes.tokens, sizes.tokens)
    scores = torch.empty(shape, dtype=torch.float32, device=B.device)
    score_chunk[(sizes.chunks, sizes.batch)](B, C, scores, **sizes.launch_kwargs(score_chunk))
    return scores
