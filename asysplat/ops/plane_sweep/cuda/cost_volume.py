"""The cost volume on GPUs: a program takes some columns and planes down a band of a view's rows.

For every neighbor, the sums along the last rows of the patches stay in registers.
"""

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED, kernel
from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.reference import prepare_inputs

RADIUS = tl.constexpr(reference.WINDOW // 2)
EARLIER = tl.constexpr(reference.WINDOW - 1)  # rows before the last of a patch
PIXEL_WEIGHT = tl.constexpr(1 / reference.WINDOW**2)  # weight of a pixel in a patch's mean
FRONT, NOISE = tl.constexpr(reference.FRONT), tl.constexpr(reference.NOISE)
UNMATCHED, SECOND = tl.constexpr(reference.UNMATCHED), tl.constexpr(reference.SECOND)
INFINITY = tl.constexpr(float("inf"))
TILE, BAND = (8192, 1024) if INTERPRETED else (128, 16)  # columns x planes, and rows, of a program


def cost_volume(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
) -> Float[Tensor, "B V H W D"]:
    """Compute the costs in float32; see `reference.cost_volume`."""
    B, V, H, W = images.shape
    inputs = prepare_inputs(images, neighbors, projections, ranges, planes)
    means = reference.patch_mean(inputs.images)
    variances = (reference.patch_mean(inputs.images**2) - means**2).clamp_min(0)
    costs = images.new_empty(B * V, H, W, planes)
    tile_planes = min(triton.next_power_of_2(planes), TILE)
    columns = min(triton.next_power_of_2(W), TILE // tile_planes)
    tiles = -(-W // columns) * -(-planes // tile_planes)
    with torch.cuda.device_of(images):
        cost_band[(tiles, -(-H // BAND), B * V)](
            *inputs,
            means=means,
            scales=(variances + reference.NOISE).rsqrt(),
            costs=costs,
            height=H,
            width=W,
            planes=planes,
            padded_planes=inputs.inverse.shape[1],
            K=neighbors.shape[2],
            COLUMNS=columns,
            PLANES=tile_planes,
            BAND=BAND,
            **FUSED,
        )
    return costs.unflatten(0, (B, V))


@kernel
def cost_band(
    images,
    padded,
    neighbors,
    projections,
    inverse,
    means,  # [n, H, W], of the patches
    scales,  # [n, H, W], 1 / the patches' standard deviations
    costs,
    height,
    width,
    planes,
    padded_planes,
    K: tl.constexpr,
    COLUMNS: tl.constexpr,
    PLANES: tl.constexpr,
    BAND: tl.constexpr,
):
    """Write the costs [n, H, W, D] of COLUMNS x PLANES in BAND rows; see `CostInputs`."""
    view = tl.program_id(2).to(tl.int64)
    parts = tl.cdiv(planes, PLANES)
    column = tl.program_id(0) // parts * COLUMNS + tl.arange(0, COLUMNS)
    plane = tl.program_id(0) % parts * PLANES + tl.arange(0, PLANES)
    depth = tl.load(inverse + view * padded_planes + plane, mask=plane < planes, other=0.0)[None, :]
    x = tl.minimum(column, width - 1)
    begin = tl.program_id(1) * BAND
    rows = tl.minimum(BAND, height - begin)
    nothing = tl.zeros((COLUMNS, PLANES), tl.float32)
    sums = ()
    for _ in tl.static_range(K * EARLIER):
        sums = sums + ((nothing, nothing, nothing),)
    for step in range(rows + 2 * RADIUS):
        y = begin + step - 2 * RADIUS  # the row whose patches this step completes
        row = tl.minimum(tl.maximum(y + RADIUS, 0), height - 1)
        middle = tl.minimum(tl.maximum(y, 0), height - 1)
        pixel = (view * height + middle) * width + x
        mean, scale = tl.load(means + pixel)[:, None], tl.load(scales + pixel)[:, None]
        first, second = nothing + INFINITY, nothing + INFINITY
        buffered = ()
        for k in tl.static_range(K):
            neighbor = tl.load(neighbors + view * K + k).to(tl.int64)
            neighbor_image = padded + tl.maximum(neighbor, 0) * (height + 1) * (width + 1)
            matrix = projections + (view * K + k) * 12
            line = images + (view * height + row) * width
            a, b, c = add_row(line, neighbor_image, matrix, x, row, depth, height, width)
            total_a, total_b, total_c = a, b, c
            for j in tl.static_range(EARLIER):
                earlier = sums[k * EARLIER + j]
                total_a += earlier[0]
                total_b += earlier[1]
                total_c += earlier[2]
                if j > 0:
                    buffered = buffered + (earlier,)
            buffered = buffered + ((a, b, c),)
            u, v, z = project(factors_at(matrix, middle), x, depth)
            visible = (z > FRONT) & (u > 0) & (u < width) & (v > 0) & (v < height)
            other_mean = total_a * PIXEL_WEIGHT
            both = total_c * PIXEL_WEIGHT - mean * other_mean
            variance = tl.maximum(total_b * PIXEL_WEIGHT - other_mean * other_mean, 0.0) + NOISE
            cost = 1 - both * scale / tl.sqrt(variance)
            cost = tl.where(visible & (neighbor >= 0), cost, INFINITY)
            second = tl.minimum(second, tl.maximum(first, cost))
            first = tl.minimum(first, cost)
        sums = buffered
        first = tl.minimum(first, UNMATCHED)
        second = tl.minimum(second, tl.minimum(first + SECOND, UNMATCHED))
        done = (column < tl.where(y >= begin, width, 0))[:, None] & (plane < planes)[None, :]
        place = costs + ((view * height + y) * width + column)[:, None] * planes + plane[None, :]
        tl.store(place, 0.5 * (first + second), mask=done)


@kernel
def add_row(line, neighbor_image, matrix, x, row, depth, height, width):
    """Return the sums along a patch's row of a neighbor, its square and its product with `line`."""
    factors = factors_at(matrix, row)
    a, b, c = 0.0, 0.0, 0.0
    for k in tl.static_range(-RADIUS, RADIUS + 1):
        column = tl.minimum(tl.maximum(x + k, 0), width - 1)
        u, v, _ = project(factors, column, depth)
        u = tl.minimum(tl.maximum(u - 0.5, 0.0), width - 1.0)
        v = tl.minimum(tl.maximum(v - 0.5, 0.0), height - 1.0)
        left, top = u.to(tl.int32), v.to(tl.int32)
        u, v = u - left, v - top
        place = neighbor_image + top * (width + 1) + left
        above, below = tl.load(place), tl.load(place + width + 1)
        above += (tl.load(place + 1) - above) * u
        below += (tl.load(place + width + 2) - below) * u
        value = above + (below - above) * v
        a += value
        b += value * value
        c += value * tl.load(line + column)[:, None]
    return a, b, c


@kernel
def factors_at(matrix, y):
    """Return the factors of x, 1 and the inverse depth in a neighbor's homogeneous coordinates.

    They are three for each coordinate, for the pixels of row y.
    """
    y += 0.5
    factors = ()
    for i in tl.static_range(3):
        row = matrix + 4 * i
        flat = tl.load(row + 1) * y + tl.load(row + 2)
        factors = factors + (tl.load(row), flat, tl.load(row + 3))
    return factors


@kernel
def project(factors, x, depth):
    """Return the coordinates and relative depths of pixels in a neighbor, [columns, planes]."""
    x = x[:, None] + 0.5
    u = factors[0] * x + factors[1] + factors[2] * depth
    v = factors[3] * x + factors[4] + factors[5] * depth
    z = factors[6] * x + factors[7] + factors[8] * depth
    scale = 1 / tl.maximum(z, FRONT)
    return u * scale, v * scale, z
