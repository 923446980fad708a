"""Sums of rows in a fixed order: what atomic additions on a GPU are not."""

from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable


def sum_runs(
    rows: Float[Tensor, "R *shape"], starts: Int[Tensor, "ends"]
) -> Float[Tensor, "ends-1 *shape"]:
    """Sum of rows starts[s] to starts[s + 1], one after the other; 0 where there are none."""
    if rows.numel() == 0 or len(starts) == 1:
        return rows.new_zeros(len(starts) - 1, *rows.shape[1:])
    flat = rows.flatten(1) if rows.ndim > 1 else rows[:, None]
    sums = torch.segment_reduce(flat, "sum", offsets=starts, axis=0, unsafe=True)
    return sums.unflatten(1, rows.shape[1:]) if rows.ndim > 1 else sums[:, 0]


class Gather:
    """rows -> rows[index], of `count` rows; the gradient of each is summed in index's order."""

    def __init__(self, index: Int[Tensor, "R"], count: int):
        self.index, self.count = index, count

    def __call__(self, rows: Tensor) -> Tensor:
        return _Gather.apply(rows, self)

    @cached_property
    def runs(self) -> tuple[Tensor, Tensor]:
        """What sorts the index, and [count + 1] where each row's run starts."""
        rows, order = torch.sort(self.index, stable=True)
        return order, torch.searchsorted(rows, torch.arange(self.count + 1, device=rows.device))


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows: Tensor, gather: Gather) -> Tensor:
        ctx.gather = gather
        return rows.index_select(0, gather.index)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        order, starts = ctx.gather.runs
        return sum_runs(grad.index_select(0, order), starts), None
