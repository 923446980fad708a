"""A segment after the other: what its heads share, then the heads."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.cpu.threads import run_blocks
from asysplat.ops.cpu.vectors import LANES
from asysplat.ops.ssd.cpu.decays import find_decays
from asysplat.ops.ssd.cpu.heads import backward_heads, forward_heads

CHUNK = 64  # tokens
SEGMENT = 16 * CHUNK  # a head's states before these chunks are 1 MB at paper scale
GROUP = 2  # heads whose gradients of B and C are summed before they leave a core


def carried_shape(x: Float[Tensor, "B L H P"], B: Float[Tensor, "B L N"]) -> tuple:
    """States before each segment: [B, segments, H, N, P in whole vectors]."""
    batch, length, heads, head_width = x.shape
    return batch, -(-length // SEGMENT), heads, B.shape[-1], _whole_vectors(head_width)


def forward(
    x: Float[Tensor, "B L H P"],
    dt: Float[Tensor, "B L H"],
    A: Float[Tensor, "H"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "H"],
    reverse: bool,
    keep: bool,
) -> tuple[Float[Tensor, "B L H P"], Float[Tensor, "_ _ _ _ _"]]:
    """y, and what `backward` needs besides, with sides of 0 if not to be kept.

    See `asysplat.ops.ssd`.
    """
    y = torch.empty_like(x)
    shape = carried_shape(x, B)
    carried = torch.empty(shape if keep else (0,) * len(shape))
    for batch in range(len(x)):
        states = torch.zeros(shape[2:])
        for index, tokens in _segments(x.shape[1], reverse):
            if keep:
                carried[batch, index] = states
            segment = _Segment(*(part[batch, tokens] for part in (x, dt, B, C)), A, D, reverse)
            segment.forward(states, y[batch, tokens])
    return y, carried


def backward(
    grad_y: Float[Tensor, "B L H P"],
    x: Float[Tensor, "B L H P"],
    dt: Float[Tensor, "B L H"],
    A: Float[Tensor, "H"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "H"],
    carried: Float[Tensor, "B S H N W"],
    reverse: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of x, dt, A, B, C and D."""
    grads = [torch.empty_like(tensor) for tensor in (x, dt, B, C)]
    grad_A, grad_D = (torch.zeros(len(A), dtype=torch.float64) for _ in range(2))
    groups, chunks = -(-len(A) // GROUP), SEGMENT // CHUNK
    parts = [
        torch.empty(chunks, groups, CHUNK, width)
        for width in (_whole_vectors(B.shape[-1]), _whole_vectors(B.shape[-1]), CHUNK)
    ]
    for batch in range(len(x)):
        grad_states = torch.zeros(carried.shape[2:])
        for index, tokens in reversed(list(_segments(x.shape[1], reverse))):
            segment = _Segment(*(part[batch, tokens] for part in (x, dt, B, C)), A, D, reverse)
            segment.backward(
                grad_y[batch, tokens],
                carried[batch, index],
                grad_states,
                [grad[batch, tokens] for grad in grads],
                grad_A,
                grad_D,
                parts,
            )
    grad_x, grad_dt, grad_B, grad_C = grads
    return grad_x, grad_dt, grad_A.float(), grad_B, grad_C, grad_D.float()


def _whole_vectors(count: int | torch.SymInt) -> int | torch.SymInt:
    """`count` numbers and those that fill the last vector."""
    return -(-count // LANES) * LANES


def _segments(length: int, reverse: bool) -> Iterator[tuple[int, slice]]:
    """Their numbers and tokens, in the direction of the scan."""
    numbers = range(-(-length // SEGMENT))
    for index in reversed(numbers) if reverse else numbers:
        yield index, slice(index * SEGMENT, min((index + 1) * SEGMENT, length))


class _Segment:
    """Up to SEGMENT tokens of one sequence as c chunks of q tokens, l in all.

    Tokens that fill the last chunk have dt = 0: they neither decay the state nor add to it.
    """

    def __init__(
        self, x: Tensor, dt: Tensor, B: Tensor, C: Tensor, A: Tensor, D: Tensor, reverse: bool
    ):
        """x [l, h, p], dt [l, h], B and C [l, N], A and D [h]."""
        self.x, self.dt = _whole_chunks(x), _whole_chunks(dt)
        self.B, self.C = (_whole_chunks(part).unflatten(0, (-1, CHUNK)) for part in (B, C))
        self.scores = self.C @ self.B.mT  # of t (row) and s
        self.decays = find_decays(self.dt.unflatten(0, (-1, CHUNK)), A, reverse)
        self.A, self.D, self.reverse = A, D, reverse

    def forward(self, states: Tensor, y: Tensor) -> None:
        """Write y [l, h, p]; take the states [h, N, width] to behind the segment."""
        with _room(y, len(self.x)) as out:
            inputs = (self.x, self.dt, self.B, self.C, self.D, self.scores)
            _run(forward_heads, len(states), *inputs, self.decays, self.reverse, states, out)

    def backward(
        self,
        grad_y: Tensor,
        carried: Tensor,
        grad_states: Tensor,
        grads: Sequence[Tensor],
        grad_A: Tensor,
        grad_D: Tensor,
        parts: Sequence[Tensor],
    ) -> None:
        """Write the gradients of x, dt, B and C, `grads`, and add to those of A and D.

        Args:
            grad_y: [l, h, p].
            carried: [h, N, width] states before the segment.
            grad_states: of the states behind the segment; taken to before it.
        """
        grad_x, grad_dt, grad_B, grad_C = grads
        part_B, part_C, part_scores = (part[: len(self.B)] for part in parts)
        with _room(grad_x, len(self.x)) as out_x, _room(grad_dt, len(self.x)) as out_dt:
            inputs = (self.x, self.dt, self.A, self.B, self.C, self.D, self.scores)
            _run(
                *(backward_heads, part_B.shape[1], _whole_chunks(grad_y), *inputs),
                *(self.decays, self.reverse, carried, grad_states),
                *(out_x, out_dt, grad_A, grad_D, part_B, part_C, part_scores),
            )
        grad_scores = part_scores.sum(1)
        for grad, part, scores, others in (
            (grad_B, part_B, grad_scores.mT, self.C),
            (grad_C, part_C, grad_scores, self.B),
        ):
            total = part.sum(1)[..., : others.shape[-1]] + scores @ others
            grad.copy_(total.flatten(0, 1)[: len(grad)])


def _whole_chunks(tokens: Tensor) -> Tensor:
    """[l ...] in fp32, zeros at the end."""
    missing = -len(tokens) % CHUNK
    if missing:
        tokens = F.pad(tokens, (0, 0) * (tokens.ndim - 1) + (0, missing))
    return tokens.float().contiguous()


@contextmanager
def _room(target: Tensor, length: int) -> Iterator[Tensor]:
    """fp32 for `length` tokens: `target`, or what is copied to it."""
    if len(target) == length and target.dtype == torch.float32:
        yield target
        return
    room = torch.empty(length, *target.shape[1:])
    yield room
    target.copy_(room[: len(target)])


def _run(kernel: Callable[..., None], count: int, *args: object) -> None:
    """One portion each: a head takes long enough."""
    arrays = (arg.numpy() if isinstance(arg, Tensor) else arg for arg in args)
    run_blocks(kernel, np.arange(count + 1), *arrays)
