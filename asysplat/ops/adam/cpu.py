"""Adam for CPUs (Numba): a task updates blocks of rows, sixteen neighboring numbers at a time.

Rows of K < 16 numbers are updated sixteen at a time, as K vectors; longer rows one at a time. A
block's gradients are checked in all tensors before its update, which then finds them in the cache.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from asysplat.kernels.simd.gathers import gather_pairs
from asysplat.kernels.simd.threads import even_bounds, inline, kernel, run_blocks
from asysplat.kernels.simd.vectors import (
    LANES,
    ZERO,
    fma,
    less,
    load,
    load_some,
    sqrt,
    store_some,
    total,
    where,
    zeros,
)
from asysplat.ops.adam.reference import AdamSettings, Rows, tabulate_corrections

BLOCK = 1024  # rows of a block


class FlatRows(NamedTuple):
    """`Rows` as NumPy arrays."""

    parameter: np.ndarray  # [N * K], like the next three
    gradient: np.ndarray
    mean: np.ndarray
    square: np.ndarray
    steps: np.ndarray  # [N]
    rates: np.ndarray  # [K, LANES] learning rates of the numbers of LANES rows
    rows: np.ndarray  # [K, LANES] row of each of these numbers, from 0 to LANES - 1


class Constants(NamedTuple):
    """The numbers of an update that all rows share; see `AdamSettings`."""

    beta2: np.float32
    new1: np.float32  # 1 - beta1, the weight of the new gradient
    new2: np.float32  # 1 - beta2, the weight of its square
    eps: np.float32
    corrections: np.ndarray  # [steps, 2], see `tabulate_corrections`


def adam_step_cpu(
    tensors: Sequence[Rows], visible: Bool[Tensor, "N"], settings: AdamSettings
) -> int:
    """Update the visible rows; see `asysplat.ops.adam.adam_step`."""
    flat = tuple(
        FlatRows(
            *(tensor.view(-1).numpy() for tensor in rows[:4]),
            rows.steps.numpy(),
            rows.rates.repeat(LANES).view(-1, LANES).numpy(),
            _row_indices(len(rows.rates)),
        )
        for rows in tensors
    )
    blocks = even_bounds(-(-len(visible) // BLOCK))
    return sum(run_blocks(update_blocks, blocks, flat, visible.numpy(), _constants(settings)))


@cache
def _row_indices(numbers: int) -> np.ndarray:
    """Return the row of each number in LANES rows of `numbers`, as [numbers, LANES]."""
    return (np.arange(numbers * LANES) // numbers).astype(np.float32).reshape(numbers, LANES)


@cache
def _constants(settings: AdamSettings) -> Constants:
    return Constants(
        beta2=np.float32(settings.beta2),
        new1=np.float32(1 - settings.beta1),
        new2=np.float32(1 - settings.beta2),
        eps=np.float32(settings.eps),
        corrections=tabulate_corrections(settings),
    )


@kernel
def update_blocks(start, stop, tensors, visible, constants):
    """Update the visible rows of blocks start to stop; return how many gradients are not finite."""
    alive = np.zeros(BLOCK, np.bool_)
    factors = np.zeros((1, BLOCK, 2), np.float32)
    dropped_rows = 0
    for block in range(start, stop):
        first = block * BLOCK
        rows = min(BLOCK, len(visible) - first)
        alive[:rows] = visible[first : first + rows]
        alive[rows:] = False
        for k in range(len(tensors)):
            dropped_rows += _drop_not_finite(alive, tensors[k], first)
        for k in range(len(tensors)):
            _count_steps(factors, alive, tensors[k], first, constants.corrections)
            _update(factors, alive, tensors[k], first, constants)
    return dropped_rows


@inline
def _rows_at_a_time(numbers):
    """Return how many rows make whole vectors: LANES, or 1 if a row fills a vector."""
    return LANES if numbers < LANES else 1


@inline
def _any(flags, first, count):
    result = False
    for i in range(first, first + count):
        result |= flags[i]
    return result


@inline
def _drop_not_finite(alive, tensor, first):
    """Remove rows with a non-finite gradient from `alive`; return their number."""
    numbers, size = len(tensor.rates), len(tensor.gradient)
    rows = _rows_at_a_time(numbers)
    dropped = 0
    for row in range(0, len(alive), rows):
        if not _any(alive, row, rows):
            continue
        begin = (first + row) * numbers
        end = min(begin + rows * numbers, size)
        sums = zeros()  # 0 times a number is NaN unless it is finite
        for i in range(begin, end, LANES):
            sums = fma(load_some(tensor.gradient, i, min(LANES, end - i)), ZERO, sums)
        if total(sums) == 0:
            continue
        for i in range(begin, end):
            local_row = i // numbers - first
            if alive[local_row] and not np.isfinite(tensor.gradient[i]):
                alive[local_row] = False
                dropped += 1
    return dropped


@inline
def _count_steps(factors, alive, tensor, first, corrections):
    """Count the step of each row in `alive`, and write the corrections of all rows to `factors`.

    The mean's is 0 for a row that is not in `alive`.
    """
    last = np.int32(len(corrections) - 1)
    for row in range(min(len(alive), len(tensor.steps) - first)):
        steps = tensor.steps[first + row] + np.int32(alive[row])
        tensor.steps[first + row] = steps
        index = np.uint32(min(steps, last))
        factors[0, row, 0] = corrections[index, 0] * np.float32(alive[row])
        factors[0, row, 1] = corrections[index, 1]


@inline
def _update(factors, alive, tensor, first, constants):
    """Update the rows in `alive`."""
    numbers, size = len(tensor.rates), len(tensor.parameter)
    rows = _rows_at_a_time(numbers)
    for row in range(0, len(alive), rows):
        if not _any(alive, row, rows):
            continue
        begin = (first + row) * numbers
        end = min(begin + rows * numbers, size)
        for k in range(-(-(end - begin) // LANES)):
            place = begin + k * LANES
            count = min(LANES, end - place)
            if rows == 1:
                to_mean, to_root = zeros() + factors[0, row, 0], zeros() + factors[0, row, 1]
            else:
                rows_of_vector = load(tensor.rows, k) + np.float32(row)
                to_mean, to_root = gather_pairs(factors, zeros(), rows_of_vector)
            parameter = load_some(tensor.parameter, place, count)
            gradient = load_some(tensor.gradient, place, count)
            mean = load_some(tensor.mean, place, count)
            square = load_some(tensor.square, place, count)
            new_mean = fma(constants.new1, gradient - mean, mean)
            new_square = fma(constants.new2 * gradient, gradient, constants.beta2 * square)
            root = fma(to_root, sqrt(new_square), constants.eps)
            step = load(tensor.rates, k) * to_mean * new_mean / root
            updated = less(zeros(), to_mean)
            store_some(tensor.parameter, place, count, where(updated, parameter - step, parameter))
            store_some(tensor.mean, place, count, where(updated, new_mean, mean))
            store_some(tensor.square, place, count, where(updated, new_square, square))
