"""Adam for GPUs (Triton): a program updates some whole rows of a tensor.

First every tensor's gradients are checked, since a row with a non-finite one keeps its numbers in
all tensors; then every tensor is updated.
"""

from collections.abc import Sequence
from functools import cache

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED, kernel
from asysplat.ops.adam.reference import AdamSettings, Rows, tabulate_corrections

TILE = 65536 if INTERPRETED else 1024  # numbers of a program


def adam_step_cuda(
    tensors: Sequence[Rows], visible: Bool[Tensor, "N"], settings: AdamSettings
) -> Int[Tensor, ""]:
    """Update the visible rows; see `asysplat.ops.adam.adam_step`."""
    alive = visible.to(torch.int8)
    corrections = _corrections_on(settings, visible.device)
    with torch.cuda.device_of(visible):
        for rows in tensors:
            grid, sizes = _launch(rows)
            drop_not_finite[grid](rows.gradient, alive, **sizes)
        for rows in tensors:
            grid, sizes = _launch(rows)
            update_rows[grid](
                *rows,
                corrections,
                alive,
                len(corrections) - 1,
                settings.beta2,
                1 - settings.beta1,
                1 - settings.beta2,
                settings.eps,
                **sizes,
                **FUSED,
            )
    return visible.sum() - alive.sum()


@cache
def _corrections_on(settings: AdamSettings, device: torch.device) -> Float[Tensor, "steps 2"]:
    return torch.from_numpy(tabulate_corrections(settings)).to(device)


def _launch(rows: Rows) -> tuple[tuple[int], dict[str, int]]:
    """Return the grid of a kernel's programs, and its sizes."""
    num, numbers = rows.parameter.shape
    width = triton.next_power_of_2(numbers)
    count = max(1, TILE // width)
    sizes = {"num": num, "NUMBERS": numbers, "WIDTH": width, "ROWS": count}
    return (triton.cdiv(num, count),), sizes


@kernel
def drop_not_finite(
    gradient, alive, num, NUMBERS: tl.constexpr, WIDTH: tl.constexpr, ROWS: tl.constexpr
):
    """Set `alive`, [num], to 0 where `gradient`, [num, NUMBERS], has a non-finite number."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    column = tl.arange(0, WIDTH)[None, :]
    exists = (row < num)[:, None] & (column < NUMBERS)
    g = tl.load(gradient + row[:, None] * NUMBERS + column, mask=exists, other=0.0)
    finite = tl.min((tl.abs(g) < float("inf")).to(tl.int8), 1)  # NaN is not less
    was_alive = tl.load(alive + row, mask=row < num, other=0)
    tl.store(alive + row, was_alive & finite, mask=row < num)


@kernel
def update_rows(
    parameter,
    gradient,
    mean,
    square,
    steps,
    rates,
    corrections,  # see `tabulate_corrections`
    alive,  # [num], 0 or 1
    last_step,  # in `corrections`
    beta2,
    new1,  # 1 - beta1
    new2,  # 1 - beta2
    eps,
    num,
    NUMBERS: tl.constexpr,
    WIDTH: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Update the rows in `alive` of one tensor; see `Rows` and `AdamSettings`."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    updated = tl.load(alive + row, mask=row < num, other=0) != 0
    step = tl.load(steps + row, mask=updated, other=0) + 1
    tl.debug_barrier()  # lanes that share a row load its step before one of them stores it
    tl.store(steps + row, step, mask=updated)
    entry = corrections + 2 * tl.minimum(step, last_step)
    to_mean, to_root = tl.load(entry)[:, None], tl.load(entry + 1)[:, None]

    column = tl.arange(0, WIDTH)[None, :]
    place = row[:, None] * NUMBERS + column
    mask = updated[:, None] & (column < NUMBERS)
    rate = tl.load(rates + column, mask=column < NUMBERS, other=0.0)
    g = tl.load(gradient + place, mask=mask, other=0.0)
    m = tl.load(mean + place, mask=mask, other=0.0)
    s = tl.load(square + place, mask=mask, other=0.0)
    m += new1 * (g - m)
    s = beta2 * s + new2 * g * g
    change = rate * to_mean * m / (to_root * tl.sqrt_rn(s) + eps)
    p = tl.load(parameter + place, mask=mask, other=0.0)
    tl.store(parameter + place, p - change, mask=mask)
    tl.store(mean + place, m, mask=mask)
    tl.store(square + place, s, mask=mask)
