"""SGM on GPUs: a program takes some rows or columns of a view, from one end to the other."""

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED, kernel
from asysplat.ops.plane_sweep import reference

SMALL_STEP, INFINITY = tl.constexpr(reference.SMALL_STEP), tl.constexpr(float("inf"))
TILE = 8192 if INTERPRETED else 256  # lines x planes


def sgm(
    costs: Float[Tensor, "B V h w D"],
    weights: Float[Tensor, "B V h w"],
    edges: Float[Tensor, "B V 2 h w"],
) -> reference.BestPlane:
    """Aggregate the costs in float32; see `reference.sgm`."""
    B, V, h, w, planes = costs.shape
    costs = costs.contiguous()
    weights = weights.clamp_min(reference.MIN_WEIGHT).contiguous()
    penalties = reference.LARGE_STEP / (1 + edges / reference.EDGE)
    total = torch.zeros_like(costs)
    tile_planes = triton.next_power_of_2(planes)
    directions = (
        (penalties[:, :, 0], (h, w), (w, 1)),  # along rows
        (penalties[:, :, 1], (w, h), (1, w)),  # along columns
    )
    with torch.cuda.device_of(costs):
        for penalty, (lines, length), (apart, step) in directions:
            tile_lines = min(triton.next_power_of_2(lines), max(TILE // tile_planes, 1))
            for reverse in (False, True):
                add_paths[(-(-lines // tile_lines), B * V)](
                    *(costs, weights, penalty.contiguous(), total),
                    lines=lines,
                    length=length,
                    apart=apart,
                    step=step,
                    planes=planes,
                    REVERSE=reverse,
                    LINES=tile_lines,
                    PLANES=tile_planes,
                    **FUSED,
                )
    return reference.find_best_plane(total)


@kernel
def add_paths(
    costs,
    weights,
    penalties,  # [n, h, w], for a step of several planes, from the pixel on the left or above
    total,
    lines,
    length,
    apart,  # stride from one line to the next
    step,  # stride from one pixel of a line to the next
    planes,
    REVERSE: tl.constexpr,
    LINES: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Add to `total` [n, h, w, D] the costs of the paths along LINES lines, in one direction."""
    view = tl.program_id(1).to(tl.int64)
    line = tl.program_id(0) * LINES + tl.arange(0, LINES)
    plane = tl.broadcast_to(tl.arange(0, PLANES)[None, :], (LINES, PLANES))
    exists = line < lines
    path = tl.zeros((LINES, PLANES), tl.float32)  # a path starts with cost 0 at all planes
    low = tl.zeros((LINES,), tl.float32)
    for k in range(length):
        position = length - 1 - k if REVERSE else k
        pixel = view * lines * length + line * apart + position * step
        # A path's first pixel has no step before it: any penalty gives the same.
        entry = pixel + tl.where(k > 0, step, 0) if REVERSE else pixel
        far = low + tl.load(penalties + entry, mask=exists, other=0.0)
        weight = tl.load(weights + pixel, mask=exists, other=0.0)[:, None]
        place = pixel[:, None] * planes + plane
        inside = exists[:, None] & (plane < planes)
        cost = tl.load(costs + place, mask=inside, other=0.0) * weight
        nearer = tl.gather(path, tl.minimum(plane + 1, PLANES - 1), 1)
        farther = tl.gather(path, tl.maximum(plane - 1, 0), 1)
        near = tl.minimum(nearer, farther) + SMALL_STEP  # the end planes are their own neighbors
        path = tl.minimum(tl.minimum(path, near), far[:, None]) - low[:, None]
        path = tl.where(plane < planes, cost + path, INFINITY)
        low = tl.min(path, 1)
        before = tl.load(total + place, mask=inside, other=0.0)
        tl.store(total + place, before + path, mask=inside)
