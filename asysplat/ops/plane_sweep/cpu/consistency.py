"""The consistency check on CPUs: a task takes a view, sixteen pixels of a row at a time."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.kernels.simd.gathers import gather_pairs
from asysplat.kernels.simd.threads import even_bounds, kernel, run_blocks
from asysplat.kernels.simd.vectors import (
    LANES,
    ONE,
    ZERO,
    fma,
    less,
    load_some,
    store_some,
    where,
    zeros,
)
from asysplat.ops.plane_sweep import reference

HALF, FRONT = np.float32(0.5), np.float32(reference.FRONT)


class ConsistencyInputs(NamedTuple):
    """The inputs of `reference.consistency` for the n views of all scenes."""

    maps: np.ndarray  # [n, h, w, 2], inverse depths and the trust in them
    steps: np.ndarray  # [n]
    others: np.ndarray  # [n, K]
    projections: np.ndarray  # [n, K, 3, 4]
    tolerance: np.float32


def consistency(
    inverse: Float[Tensor, "B V h w"],
    steps: Float[Tensor, "B V"],
    trust: Float[Tensor, "B V h w"],
    others: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    tolerance: float = reference.TOLERANCE,
) -> reference.Consistency:
    """Count in float32; see `reference.consistency`."""
    B, V, h, w = inverse.shape
    inputs = ConsistencyInputs(
        maps=torch.stack((inverse, trust), dim=-1).flatten(0, 1).numpy(),
        steps=steps.flatten().numpy(),
        others=others.flatten(0, 1).contiguous().numpy(),
        projections=projections.flatten(0, 1).contiguous().numpy(),
        tolerance=np.float32(tolerance),
    )
    result = reference.Consistency(
        *(torch.empty(B, V, h, w) for _ in reference.Consistency._fields)
    )
    arrays = reference.Consistency(*(counts.flatten(0, 1).numpy() for counts in result))
    run_blocks(count_views, even_bounds(B * V), inputs, V, arrays)
    return result


@kernel
def count_views(start, stop, inputs, views, counts):
    """Write the counts, each [n, h, w], of the views start to stop; a scene has `views` views."""
    h, w = inputs.maps.shape[1:3]
    bottom, right = np.float32(h), np.float32(w)
    columns = np.arange(w).astype(np.float32) + HALF
    for n in range(start, stop):
        for y in range(h):
            row = np.float32(y) + HALF
            view_depths = inputs.maps[n, y, :, 0].copy()
            for x in range(0, w, LANES):
                count = min(LANES, w - x)
                column, depth = load_some(columns, x, count), load_some(view_depths, x, count)
                agreeing, contradicting = zeros(), zeros()
                occluding, containing = zeros(), zeros()
                for k in range(inputs.others.shape[1]):
                    if inputs.others[n, k] < 0:
                        continue
                    other_view = n // views * views + inputs.others[n, k]
                    m = inputs.projections[n, k]
                    z = fma(depth, m[2, 3], fma(column, m[2, 0], fma(m[2, 1], row, m[2, 2])))
                    scale = ONE / max(z, FRONT)
                    u = fma(depth, m[0, 3], fma(column, m[0, 0], fma(m[0, 1], row, m[0, 2])))
                    v = fma(depth, m[1, 3], fma(column, m[1, 0], fma(m[1, 1], row, m[1, 2])))
                    u, v = u * scale, v * scale
                    inside = less(ZERO, u) & less(u, right) & less(ZERO, v) & less(v, bottom)
                    inside = inside & less(FRONT, z)
                    u = min(max(u, ZERO), right - ONE)
                    v = min(max(v, ZERO), bottom - ONE)
                    stored, trust = gather_pairs(inputs.maps[other_view], v, u)
                    nearer = depth * scale - stored
                    limit = max(stored * inputs.tolerance, inputs.steps[other_view] * HALF)
                    weight = where(inside, trust, ZERO)
                    farther = ZERO - nearer
                    apart = max(nearer, farther)
                    agreeing = agreeing + where(less(limit, apart), ZERO, weight)
                    contradicting = contradicting + where(less(limit, nearer), weight, ZERO)
                    occluding = occluding + where(less(limit, farther), weight, ZERO)
                    containing = containing + where(inside, ONE, ZERO)
                store_some(counts.agreeing[n, y], x, count, agreeing)
                store_some(counts.contradicting[n, y], x, count, contradicting)
                store_some(counts.occluding[n, y], x, count, occluding)
                store_some(counts.containing[n, y], x, count, containing)
