"""Sums along rows and columns on GPUs: a program takes some lines of a view, there and back."""

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED, kernel
from asysplat.ops.plane_sweep import reference

TILE = 4096 if INTERPRETED else 128  # lines x numbers


def spread(
    values: Float[Tensor, "B V h w C"], keep: Float[Tensor, "B V 2 h w"]
) -> Float[Tensor, "B V h w C"]:
    """Compute the sums in float32; see `reference.spread`."""
    B, V, h, w, numbers = values.shape
    values, tile_numbers = values.contiguous(), triton.next_power_of_2(numbers)
    directions = (
        (keep[:, :, 0].contiguous(), (h, w), (w, 1)),  # along rows
        (keep[:, :, 1].contiguous(), (w, h), (1, w)),  # along columns
    )
    with torch.cuda.device_of(values):
        for _ in range(reference.SPREAD_ROUNDS):
            for factors, (lines, length), (apart, step) in directions:
                sums = torch.empty_like(values)
                tile_lines = min(triton.next_power_of_2(lines), max(TILE // tile_numbers, 1))
                spread_lines[(-(-lines // tile_lines), B * V)](
                    *(values, factors, sums),
                    lines=lines,
                    length=length,
                    apart=apart,
                    step=step,
                    numbers=numbers,
                    LINES=tile_lines,
                    NUMBERS=tile_numbers,
                    **FUSED,
                )
                values = sums
    return values


@kernel
def spread_lines(
    values,
    keep,  # [n, h, w], from the pixel on the left or above
    sums,
    lines,
    length,
    apart,  # stride from one line to the next
    step,  # stride from one pixel of a line to the next
    numbers,
    LINES: tl.constexpr,
    NUMBERS: tl.constexpr,
):
    """Write the sums [n, h, w, C] along LINES lines."""
    view = tl.program_id(1).to(tl.int64)
    line = tl.program_id(0) * LINES + tl.arange(0, LINES)
    number = tl.arange(0, NUMBERS)[None, :]
    exists = line < lines
    inside = exists[:, None] & (number < numbers)
    first = view * lines * length + line * apart
    before = tl.zeros((LINES, NUMBERS), tl.float32)
    for k in range(length):
        pixel = first + k * step
        factor = tl.load(keep + pixel, mask=exists, other=0.0)[:, None]
        place = pixel[:, None] * numbers + number
        before = before * factor + tl.load(values + place, mask=inside, other=0.0)
        tl.store(sums + place, before, mask=inside)
    behind = tl.zeros((LINES, NUMBERS), tl.float32)
    for k in range(length):
        pixel = first + (length - 1 - k) * step
        factor = tl.load(keep + pixel, mask=exists, other=0.0)[:, None]
        place = pixel[:, None] * numbers + number
        total = tl.load(sums + place, mask=inside, other=0.0)
        tl.store(sums + place, total + behind, mask=inside)
        behind = (behind + tl.load(values + place, mask=inside, other=0.0)) * factor
