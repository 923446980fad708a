"""The consistency check on GPUs: a program takes some pixels of a view, and all other views."""

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED, kernel
from asysplat.ops.plane_sweep import reference

FRONT = tl.constexpr(reference.FRONT)
PIXELS = 8192 if INTERPRETED else 256  # pixels of a program


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
    inputs = (tensor.contiguous() for tensor in (inverse, steps, trust, others, projections))
    counts = reference.Consistency(
        *(inverse.new_empty(B, V, h, w) for _ in reference.Consistency._fields)
    )
    with torch.cuda.device_of(inverse):
        count_views[(triton.cdiv(h * w, PIXELS), B * V)](
            *(*inputs, *counts, tolerance),
            views=V,
            neighbors=others.shape[2],
            height=h,
            width=w,
            PIXELS=PIXELS,
            **FUSED,
        )
    return counts


@kernel
def count_views(
    inverse,
    steps,
    trust,
    others,
    projections,
    agreeing,
    contradicting,
    occluding,
    containing,
    tolerance,
    views,  # number of views of a scene
    neighbors,  # number of views in `others` for each view
    height,
    width,
    PIXELS: tl.constexpr,
):
    """Write the counts of PIXELS pixels of a view; see `reference.consistency`."""
    view = tl.program_id(1).to(tl.int64)
    first = view // views * views
    place = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = place < height * width
    pixel = view * height * width + place
    x, y = place % width + 0.5, place // width + 0.5
    depth = tl.load(inverse + pixel, mask=exists, other=0.0)
    agree = tl.zeros((PIXELS,), tl.float32)
    contradict, occlude, contain = agree, agree, agree
    for k in range(neighbors):
        other_view = tl.load(others + view * neighbors + k)
        if other_view >= 0:
            m = projections + (view * neighbors + k) * 12
            u = tl.load(m) * x + tl.load(m + 1) * y + tl.load(m + 2) + tl.load(m + 3) * depth
            v = tl.load(m + 4) * x + tl.load(m + 5) * y + tl.load(m + 6) + tl.load(m + 7) * depth
            z = tl.load(m + 8) * x + tl.load(m + 9) * y + tl.load(m + 10) + tl.load(m + 11) * depth
            scale = 1 / tl.maximum(z, FRONT)
            u, v = u * scale, v * scale
            inside = (z > FRONT) & (u > 0) & (u < width) & (v > 0) & (v < height)
            column = tl.minimum(tl.maximum(u, 0.0), width - 1.0).to(tl.int32)
            row = tl.minimum(tl.maximum(v, 0.0), height - 1.0).to(tl.int32)
            there = ((first + other_view) * height + row) * width + column
            stored = tl.load(inverse + there)
            weight = tl.where(inside, tl.load(trust + there), 0.0)
            nearer = depth * scale - stored
            limit = tl.maximum(stored * tolerance, tl.load(steps + first + other_view) * 0.5)
            agree += tl.where(tl.abs(nearer) <= limit, weight, 0.0)
            contradict += tl.where(nearer > limit, weight, 0.0)
            occlude += tl.where(nearer < -limit, weight, 0.0)
            contain += inside.to(tl.float32)
    tl.store(agreeing + pixel, agree, mask=exists)
    tl.store(contradicting + pixel, contradict, mask=exists)
    tl.store(occluding + pixel, occlude, mask=exists)
    tl.store(containing + pixel, contain, mask=exists)
