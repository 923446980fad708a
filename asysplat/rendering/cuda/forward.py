"""Splats to pixels, front to back: a program draws a tile."""

import triton.language as tl

from asysplat.rendering.cuda.kernel import (
    alpha_at,
    kernel,
    load_color,
    load_shape,
    offset,
    tile_pixels,
)


@kernel
def draw_tile(
    splats,
    entries,
    first_entry,
    last_entry,
    image,
    alpha,
    depth,
    columns,
    tiles,
    height,
    width,
    alpha_min,
    alpha_max,
    transmittance_min,
    HAS_DEPTH: tl.constexpr,
    MEDIAN: tl.constexpr,
    SKIP_OPAQUE: tl.constexpr,
    CHANNELS: tl.constexpr,
    TILE: tl.constexpr,
    STEP: tl.constexpr,
):
    """Every pixel of the tile is written.

    Args:
        splats: [M, CHANNELS], see `project`. entries, first_entry: see `TileLists`.
        last_entry: [tiles of all images] is set to where the list was left, all pixels opaque.
        image, alpha, depth: see `Layers`; depth is read only with HAS_DEPTH.
        columns, tiles: of tiles, in an image.
        STEP: splats between two looks at whether all pixels are opaque.
    """
    tile = tl.program_id(0).to(tl.int64)
    picture, column, row, inside = tile_pixels(tile, columns, tiles, height, width, TILE)
    center_x, center_y = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    left_over = inside.to(tl.float32)
    total_alpha = tl.zeros_like(left_over)
    total_red = tl.zeros_like(left_over)
    total_green = tl.zeros_like(left_over)
    total_blue = tl.zeros_like(left_over)
    total_depth = tl.zeros_like(left_over)
    position = tl.load(first_entry + tile)
    end = tl.load(first_entry + tile + 1)
    drawing = position < end
    while drawing:
        for k in tl.static_range(STEP):
            there = position + k < end
            index = tl.load(entries + position + k, mask=there, other=0)
            splat = splats + index.to(tl.int64) * CHANNELS
            x, y, a, b, c, opacity = load_shape(splat, there)
            red, green, blue = load_color(splat, there)
            before = left_over
            hit, left_over, _, _ = alpha_at(
                center_x - x,
                center_y - y,
                a,
                b,
                c,
                opacity,
                before,
                alpha_min,
                alpha_max,
                transmittance_min,
            )
            weight = hit * before
            total_alpha = tl.fma(hit, before, total_alpha)
            total_red = tl.fma(weight, red, total_red)
            total_green = tl.fma(weight, green, total_green)
            total_blue = tl.fma(weight, blue, total_blue)
            if HAS_DEPTH:
                z = tl.load(splat + 9, mask=there, other=0.0)
                if MEDIAN:
                    halves = (before > 0.5) & (left_over <= 0.5) & (hit > 0)
                    total_depth += tl.where(halves, z, 0.0)
                else:
                    total_depth = tl.fma(weight, z, total_depth)
        position += STEP
        drawing = position < end
        if SKIP_OPAQUE:
            drawing = drawing & (tl.max(left_over, 0) >= transmittance_min)
    tl.store(last_entry + tile, tl.minimum(position, end))
    pixel = offset(picture, row, column, height, width)
    tl.store(alpha + pixel, total_alpha, mask=inside)
    tl.store(image + offset(3 * picture, row, column, height, width), total_red, mask=inside)
    tl.store(image + offset(3 * picture + 1, row, column, height, width), total_green, mask=inside)
    tl.store(image + offset(3 * picture + 2, row, column, height, width), total_blue, mask=inside)
    if HAS_DEPTH:
        tl.store(depth + pixel, total_depth, mask=inside)
