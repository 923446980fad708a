"""SSD in chunks for CPUs: matrix products by torch, the decays between them by Numba.

Dao and Gu 2024, Section 6. A segment of chunks is worked on at a time, so that what passes between
the products stays near the processor; nothing is stored between the passes but the state before
each segment. A state is [N, H P], so that both products with it are one for all heads.
"""

import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from asysplat.ops.cpu.threads import even_bounds, run_blocks
from asysplat.ops.ssd.decays import mix, unmix

CHUNK = 64  # tokens
SEGMENT = 16 * CHUNK


def carried_shape(x: Tensor, B: Tensor) -> tuple:
    """States before each segment: [B, segments, N, H P]."""
    batch, length, heads, head_width = x.shape
    return batch, -(-length // SEGMENT), B.shape[-1], heads * head_width


def forward(
    x: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor, reverse: bool
) -> tuple[Tensor, Tensor]:
    """y, and what `backward` needs besides; see `asysplat.ops.ssd`."""
    y = torch.empty(x.shape, dtype=x.dtype)
    carried = torch.empty(carried_shape(x, B))
    for batch in range(len(x)):
        state = torch.zeros(carried.shape[2:])
        for index, tokens in _segments(x.shape[1], reverse):
            carried[batch, index] = state
            inputs = (tensor[batch, tokens] for tensor in (x, dt, B, C))
            y[batch, tokens] = _Segment(*inputs, A, D, reverse).forward(state)
    return y, carried


def backward(
    grad_y: Tensor,
    x: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor,
    carried: Tensor,
    reverse: bool,
) -> tuple[Tensor, ...]:
    """Gradients of x, dt, A, B, C and D."""
    grad_x, grad_dt, grad_B, grad_C = grads = [torch.empty_like(t) for t in (x, dt, B, C)]
    grad_A, grad_D = torch.zeros_like(A), torch.zeros_like(D)
    for batch in range(len(x)):
        grad_state = torch.zeros(carried.shape[2:])
        for index, tokens in reversed(list(_segments(x.shape[1], reverse))):
            inputs = (tensor[batch, tokens] for tensor in (x, dt, B, C))
            segment = _Segment(*inputs, A, D, reverse)
            *parts, part_A, part_D = segment.backward(
                grad_y[batch, tokens].float(), carried[batch, index], grad_state
            )
            for grad, part in zip(grads, parts, strict=True):
                grad[batch, tokens] = part
            grad_A += part_A
            grad_D += part_D
    return grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D


def _segments(length: int, reverse: bool) -> Iterator[tuple[int, slice]]:
    """Their numbers and tokens, in the direction of the scan."""
    numbers = range(-(-length // SEGMENT))
    for index in reversed(numbers) if reverse else numbers:
        yield index, slice(index * SEGMENT, min((index + 1) * SEGMENT, length))


class _Segment:
    """Up to SEGMENT tokens of one sequence as c chunks of q tokens.

    Tokens that fill the last chunk have dt = 0: they neither decay the state nor add to it.
    """

    def __init__(
        self, x: Tensor, dt: Tensor, B: Tensor, C: Tensor, A: Tensor, D: Tensor, reverse: bool
    ):
        """x [l, h, p], dt [l, h], B and C [l, n], A and D [h]."""
        self.x, self.dt, self.A, self.D, self.reverse = x.float(), dt, A, D[:, None], reverse
        self.inputs = _chunks(self.x * dt[..., None])  # [c q h p]
        self.B, self.C = _chunks(B.float()), _chunks(C.float())  # [c q n]
        self.scores = self.C @ self.B.mT  # of t (row) and s
        logs = _chunks(dt.double() * A.double() / math.log(2))
        logs = logs.flip(1).cumsum(1).flip(1) if reverse else logs.cumsum(1)
        total = logs[:, :1] if reverse else logs[:, -1:]
        # Decays from where the scan enters the chunk, and to where it leaves it [c q h 1].
        self.from_start = logs.exp2().float()[..., None]
        self.to_end = (total - logs).exp2().float()[..., None]
        self.across = total.exp2().float().mT  # [c h 1]
        self.weighted = self.inputs * self.to_end
        logs = logs.mT.contiguous()
        self.high = logs.float()
        self.low = (logs - self.high).float()
        self.order = range(len(logs))[:: -1 if reverse else 1]

    def forward(self, state: Tensor) -> Tensor:
        """y [l, h, p]; the state is taken to the segment's end."""
        y = _tokens_first(self.weights() @ _heads_first(self.inputs))
        for chunk in self.order:
            read = (self.C[chunk] @ state).view(y.shape[1:])
            y[chunk].addcmul_(read, self.from_start[chunk])
            self.update(chunk, state)
        return torch.addcmul(self.tokens(y), self.x, self.D)

    def weights(self) -> Tensor:
        """[c h q q] of token s in token t."""
        weights = self.x.new_empty(len(self.high), self.dt.shape[1], CHUNK, CHUNK)
        run_blocks(mix, even_bounds(self.high.shape[:2].numel()), *self.decays(), weights.numpy())
        return weights

    def decays(self) -> tuple:
        """As `mix` and `unmix` take them."""
        return self.scores.numpy(), self.high.numpy(), self.low.numpy(), self.reverse

    def update(self, chunk: int, state: Tensor) -> None:
        """Take the state [n, h p] from before a chunk to behind it."""
        state.view(len(state), len(self.A), -1).mul_(self.across[chunk])
        state.addmm_(self.B[chunk].mT, self.weighted[chunk].flatten(1))

    def backward(self, pull: Tensor, state: Tensor, grad_state: Tensor) -> tuple[Tensor, ...]:
        """Gradients of x, dt, B, C, A, D from that of y, `pull` [l, h, p], and the state before the
        segment; that of the state is taken from behind the segment to before it."""
        states, state = [], state.clone()
        for chunk in self.order:
            states.append(state.clone())
            self.update(chunk, state)
        grad_inputs, grad_B, grad_C, grad_logs = self.backward_within(_chunks(pull))
        read_pull = _chunks(pull) * self.from_start
        heads, width = read_pull.shape[2:]
        read = torch.empty_like(read_pull)
        written = torch.empty_like(read_pull)
        left = torch.empty_like(self.across)
        for chunk, state in zip(reversed(self.order), reversed(states), strict=True):
            # What the tokens added to the state behind the chunk.
            torch.mm(self.B[chunk], grad_state, out=written[chunk].view(CHUNK, -1))
            grad_B[chunk].addmm_(self.weighted[chunk].flatten(1), grad_state.mT)
            # What was left of the state before it, and what was read of that.
            kept = (state * grad_state).view(-1, heads, width).sum((0, 2))
            left[chunk] = kept[:, None] * self.across[chunk]
            torch.mm(self.C[chunk], state, out=read[chunk].view(CHUNK, -1))
            grad_C[chunk].addmm_(read_pull[chunk].flatten(1), state.mT)
            grad_state.view(-1, heads, width).mul_(self.across[chunk])
            grad_state.addmm_(self.C[chunk].mT, read_pull[chunk].flatten(1))
        grad_inputs.addcmul_(written, self.to_end)
        read_share = read.mul_(read_pull).sum(-1).double()  # [c q h]
        write_share = written.mul_(self.weighted).sum(-1).double()

        # A token's decay acts on what was written before it and is read at it or behind it.
        # Sums of the tokens behind and before, none taken away again: a difference would keep the
        # rounding of the largest.
        behind = _sum_behind(read_share, self.reverse)
        before = _sum_behind(_previous(write_share, self.reverse), not self.reverse)
        grad_decay = self.tokens(grad_logs + behind + before + left.mT).float()
        grad_inputs = self.tokens(grad_inputs)
        return (
            torch.addcmul(grad_inputs * self.dt[..., None], pull, self.D),
            grad_decay * self.A + (grad_inputs * self.x).sum(-1),
            self.tokens(grad_B),
            self.tokens(grad_C),
            (grad_decay * self.dt).sum(0),
            (pull * self.x).sum((0, 2)),
        )

    def backward_within(self, pull: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gradients of inputs, B, C and, float64, [c q h], logarithms, from what the tokens of a
        chunk see of one another."""
        pull = _heads_first(pull)
        grad_inputs = _tokens_first(self.weights().mT @ pull)
        grad_weights = pull @ _heads_first(self.inputs).mT
        grad_scores = torch.empty_like(self.scores)
        grad_logs = torch.empty(self.high.shape, dtype=torch.float64)
        run_blocks(
            unmix,
            even_bounds(len(self.high)),
            grad_weights.numpy(),
            *self.decays(),
            grad_scores.numpy(),
            grad_logs.numpy(),
        )
        return grad_inputs, grad_scores.mT @ self.C, grad_scores @ self.B, grad_logs.mT

    def tokens(self, chunks: Tensor) -> Tensor:
        """[c q ...] -> [l ...]"""
        return chunks.flatten(0, 1)[: len(self.x)]


def _chunks(tokens: Tensor) -> Tensor:
    """[l ...] -> [c q ...], zeros at the end."""
    missing = -len(tokens) % CHUNK
    if missing:
        tokens = F.pad(tokens, (0, 0) * (tokens.ndim - 1) + (0, missing))
    return tokens.unflatten(0, (-1, CHUNK))


def _heads_first(tensor: Tensor) -> Tensor:
    """[c q h p] -> [c h q p]"""
    return tensor.transpose(1, 2).contiguous()


def _tokens_first(tensor: Tensor) -> Tensor:
    """[c h q p] -> [c q h p]"""
    return tensor.transpose(1, 2).contiguous()


def _sum_behind(shares: Tensor, reverse: bool) -> Tensor:
    """[c q h]: of each token and those of its chunk that the scan comes to later."""
    return shares.cumsum(1) if reverse else shares.flip(1).cumsum(1).flip(1)


def _previous(shares: Tensor, reverse: bool) -> Tensor:
    """[c q h]: of the token of the chunk that the scan came to just before, 0 at the first."""
    if reverse:
        return F.pad(shares[:, 1:], (0, 0, 0, 1))
    return F.pad(shares[:, :-1], (0, 0, 1, 0))
