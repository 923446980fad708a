"""Splats to pixels, front to back: a program draws a tile."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.rendering.cuda.splat import load_color, load_depth, load_shape
from asysplat.rendering.cuda.tile import HALF_TILE, alpha_at, color_pixels, tile_pixels

NEVER = tl.constexpr(2**31 - 1)  # more than any rank


@kernel
def draw_tile(
    splats,
    entries,
    first_entry,
    last_entry,
    wanted,
    image,
    alpha,
    transmittance,
    depth,
    origins,
    stops,
    halved,
    columns,
    tiles,
    height,
    width,
    alpha_min,
    alpha_max,
    transmittance_min,
    MASKED: tl.constexpr,
    DEPTH: tl.constexpr,
    MEDIAN: tl.constexpr,
    SKIP_OPAQUE: tl.constexpr,
    STEP: tl.constexpr,
):
    """Every pixel of the tile is written.

    Args:
        splats: [images * N, 16], see `splat`.
        entries: [pairs] the splat of each, sorted by tile, then by depth.
        first_entry: [tiles + 1] where each tile's list begins.
        last_entry: [tiles] is set to where it was left, all its pixels being opaque.
        wanted: [tiles] whether to draw it; read only with MASKED.
        image, alpha, transmittance, depth, origins: see `Layers`; DEPTH and MEDIAN say whether the
            last two are there, one of them or none.
        stops: [images, H, W] the rank in its list of the splat that a pixel dropped, and all behind
            it; NEVER where it dropped none.
        halved: [images, H, W] the rank of the splat of the median depth, -1 without one.
        columns, tiles: of an image.
        STEP: splats between two looks at whether all pixels are opaque.
    """
    tile = tl.program_id(0).to(tl.int64)
    picture, left, top, lane_x, lane_y, pixel, inside = tile_pixels(
        tile, columns, tiles, height, width
    )
    passed = tl.full(lane_x.shape, 1.0, tl.float32)
    live = inside
    stop = tl.full(lane_x.shape, NEVER, tl.int32)
    total_alpha = tl.zeros_like(passed)
    total_red = tl.zeros_like(passed)
    total_green = tl.zeros_like(passed)
    total_blue = tl.zeros_like(passed)
    total_depth = tl.zeros_like(passed)
    origin = tl.zeros_like(passed)
    half = tl.full(lane_x.shape, -1, tl.int32)
    first = tl.load(first_entry + tile)
    end = tl.load(first_entry + tile + 1)
    if MASKED:
        end = tl.where(tl.load(wanted + tile), end, first)
    position = first
    drawing = position < end
    while drawing:
        for k in tl.static_range(STEP):
            there = position + k < end
            rank = (position + k - first).to(tl.int32)
            d = tl.load(entries + position + k, mask=there, other=0).to(tl.int64)
            _, _, y, rest_y, u, a, b, c, log_opacity = load_shape(
                splats, d, left, top, HALF_TILE, there
            )
            red, green, blue = load_color(splats, d, there)
            v = c * ((y + lane_y) + rest_y)
            u = tl.fma(a, lane_x, tl.fma(b, lane_y, u))
            shows = tl.where(live, alpha_at(u, v, log_opacity, alpha_min, alpha_max), 0.0)
            behind = tl.fma(-shows, passed, passed)
            drops = live & (behind < transmittance_min)
            stop = tl.where(drops, rank, stop)
            live = live & (behind >= transmittance_min)
            shows = tl.where(drops, 0.0, shows)
            weight = shows * passed
            total_alpha += weight
            total_red = tl.fma(weight, red, total_red)
            total_green = tl.fma(weight, green, total_green)
            total_blue = tl.fma(weight, blue, total_blue)
            if DEPTH:
                # From the depth of the first that shows: what is blended are small differences.
                z, rest_z = load_depth(splats, d, there)
                origin = tl.where((passed == 1) & (weight > 0), z, origin)
                total_depth = tl.fma(weight, (z - origin) + rest_z, total_depth)
            if MEDIAN:
                z, _ = load_depth(splats, d, there)
                halves = (passed > 0.5) & (weight > 0) & (behind <= 0.5)
                total_depth = tl.where(halves, z, total_depth)
                half = tl.where(halves, rank, half)
            passed = tl.where(drops, passed, behind)
        position += STEP
        drawing = position < end
        if SKIP_OPAQUE:
            drawing = drawing & (tl.max(live.to(tl.int32), 0) > 0)
    tl.store(last_entry + tile, tl.minimum(position, end))
    red_pixel, green_pixel, blue_pixel = color_pixels(pixel, picture, height, width)
    tl.store(alpha + pixel, total_alpha, mask=inside)
    tl.store(transmittance + pixel, passed, mask=inside)
    tl.store(stops + pixel, stop, mask=inside)
    tl.store(image + red_pixel, total_red, mask=inside)
    tl.store(image + green_pixel, total_green, mask=inside)
    tl.store(image + blue_pixel, total_blue, mask=inside)
    if DEPTH:
        tl.store(depth + pixel, total_depth, mask=inside)
        tl.store(origins + pixel, origin, mask=inside)
    if MEDIAN:
        tl.store(depth + pixel, total_depth, mask=inside)
        tl.store(halved + pixel, half, mask=inside)
