"""Splats: their columns, the frame they are drawn in, and their position relative to a tile."""

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from asysplat.kernels.simd.threads import inline
from asysplat.kernels.simd.vectors import LANES, fma
from asysplat.rendering.formulas import MAX_CENTER_OFFSET, PIXEL_MARGIN

# A splat is 16 float32, one cache line; BASE_* are int32, *_REST are rounding errors of float32.
# alpha = 2^(LOG_OPACITY - (A dx + B dy)^2 - (C dy)^2), with its center at (BASE_X + X, BASE_Y + Y).
# It ends EXTENT_Y above and below its center.
X, Y, A, B, C, LOG_OPACITY, RED, GREEN, BLUE, DEPTH = range(10)
BASE_X, BASE_Y, A_REST, B_REST, DEPTH_REST, EXTENT_Y = range(10, 16)
SPLAT = 16

# Gradients [10] float32 of a splat in one tile; for X to LOG_OPACITY a factor ln 2 is left out.
G_X, G_Y, G_A, G_B, G_C, G_LOG_OPACITY, G_RED, G_GREEN, G_BLUE, G_DEPTH = range(10)
GRADIENT = 10

TILE = 16  # pixels a side; a row of them is one vector
HALF = np.float32(0.5)
MIDDLE = np.float32((LANES - 1) / 2)


class ProjectSettings(NamedTuple):
    """Settings of the projection; alpha_min to compensation_min as in `BlendingLimits`."""

    alpha_min: float
    log_alpha_min: float  # to base 2
    eps2d: float
    near: float
    compensation_min: float
    antialiased: bool
    cull_opacity: bool
    cull_frustum: bool
    cull_extent: bool
    cull_ellipse: bool


class RasterSettings(NamedTuple):
    """Settings of the rasterization; the cut-offs as in `BlendingLimits`."""

    alpha_min: np.float32
    alpha_max: np.float32
    transmittance_min: np.float32
    cull_rows: bool
    cull_opaque: bool


class Frame(NamedTuple):
    """Sizes and settings for every kernel."""

    images: int  # views of all scenes
    views: int  # views of a scene
    num: int  # Gaussians of a scene
    blocks: int  # blocks of Gaussians in an image
    block_size: int  # Gaussians
    height: int  # pixels
    width: int
    columns: int  # tile columns of an image
    tiles: int  # tiles of an image
    project: ProjectSettings
    raster: RasterSettings


class Ellipse(NamedTuple):
    """The extent of a splat, in float64: (a dx + b dy)^2 + (c dy)^2 <= (c extent_y)^2."""

    x: float
    y: float
    a: float
    b: float
    c: float
    extent_y: float


class Window(NamedTuple):
    """A tile: its image, its first column and row, its numbers of rows and columns."""

    image: int
    left: int
    top: int
    rows: int
    columns: int


class TileSplat(NamedTuple):
    """A splat relative to a tile.

    (x, y) is the middle of the tile's first row, relative to the splat's center; u = A x + B y
    there grows by b a row. These are float64: far from the center of a needle the two terms nearly
    cancel.
    """

    x: float
    y: float
    u: float
    b: float
    a: np.float32
    c: np.float32
    log_opacity: np.float32
    red: np.float32
    green: np.float32
    blue: np.float32
    z: np.float32
    z_rest: np.float32


class Row(NamedTuple):
    """A splat relative to a row of a tile."""

    base: int  # where the row begins in a plane of the tile's state
    dy: np.float32  # from the splat's center down to the row
    exponent: np.float32  # exponent of 2 in alpha where u is 0
    middle: np.float32  # u in the middle of the row


@inline
def store_ellipse(splats, bases, d, ellipse, log_opacity, z):
    """Round a splat's ellipse, opacity and depth to float32."""
    x, y, a, b, c, extent_y = ellipse
    base_x = min(max(np.floor(x), -MAX_CENTER_OFFSET), MAX_CENTER_OFFSET)
    base_y = min(max(np.floor(y), -MAX_CENTER_OFFSET), MAX_CENTER_OFFSET)
    bases[d, BASE_X], bases[d, BASE_Y] = np.int32(base_x), np.int32(base_y)
    splats[d, X], splats[d, Y] = x - base_x, y - base_y
    splats[d, A], splats[d, B] = a, b
    splats[d, A_REST] = a - np.float64(np.float32(a))
    splats[d, B_REST] = b - np.float64(np.float32(b))
    splats[d, C] = c
    splats[d, LOG_OPACITY] = log_opacity
    splats[d, DEPTH] = z
    splats[d, DEPTH_REST] = z - np.float64(np.float32(z))
    splats[d, EXTENT_Y] = min(extent_y * (1 + 1e-6), MAX_CENTER_OFFSET)


@inline
def load_ellipse(splats, bases, d):
    """Read the ellipse of splat d."""
    return Ellipse(
        x=np.float64(bases[d, BASE_X]) + np.float64(splats[d, X]),
        y=np.float64(bases[d, BASE_Y]) + np.float64(splats[d, Y]),
        a=np.float64(splats[d, A]) + np.float64(splats[d, A_REST]),
        b=np.float64(splats[d, B]) + np.float64(splats[d, B_REST]),
        c=np.float64(splats[d, C]),
        extent_y=np.float64(splats[d, EXTENT_Y]),
    )


@inline
def tile_window(tile, frame):
    """Compute the pixels of a tile; tiles are numbered image by image, row by row."""
    left = tile % frame.tiles % frame.columns * TILE
    top = tile % frame.tiles // frame.columns * TILE
    rows, columns = min(TILE, frame.height - top), min(TILE, frame.width - left)
    return Window(tile // frame.tiles, left, top, rows, columns)


@inline
def load_splat(splats, bases, d, window):
    """Read splat d relative to a tile."""
    x = window.left + float(MIDDLE + HALF) - np.float64(bases[d, BASE_X]) - np.float64(splats[d, X])
    y = window.top + float(HALF) - np.float64(bases[d, BASE_Y]) - np.float64(splats[d, Y])
    a = np.float64(splats[d, A]) + np.float64(splats[d, A_REST])
    b = np.float64(splats[d, B]) + np.float64(splats[d, B_REST])
    return TileSplat(
        x=x,
        y=y,
        u=a * x + b * y,
        b=b,
        a=splats[d, A],
        c=splats[d, C],
        log_opacity=splats[d, LOG_OPACITY],
        red=splats[d, RED],
        green=splats[d, GREEN],
        blue=splats[d, BLUE],
        z=splats[d, DEPTH],
        z_rest=splats[d, DEPTH_REST],
    )


@inline
def visible_rows(splats, d, y, rows):
    """Compute the first and the last of a tile's rows that splat d can reach; see `TileSplat.y`."""
    extent = np.float64(splats[d, EXTENT_Y]) + PIXEL_MARGIN
    first = math.ceil(max(-y - extent, 0.0))
    last = math.floor(min(-y + extent, rows - 1.0))
    return first, last


@inline
def splat_in_row(splat, row):
    """Compute a splat relative to a row of the tile."""
    dy = np.float32(splat.y + row)
    v = splat.c * dy
    base = (row & (TILE - 1)) * LANES
    return Row(base, dy, fma(-v, v, splat.log_opacity), np.float32(splat.u + splat.b * row))


@intrinsic
def prefetch(typing_context, rows, row):
    """Prefetch a row of a 2D array."""

    def generate(context, builder, signature, args):
        array_type, row_type = signature.args
        array = context.make_array(array_type)(context, builder, args[0])
        row = context.cast(builder, args[1], row_type, types.intp)
        stride = builder.extract_value(array.strides, 0)
        byte = builder.bitcast(array.data, ir.IntType(8).as_pointer())
        pointer = builder.gep(byte, [builder.mul(row, stride)])
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, *[ir.IntType(32)] * 3])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        read, keep, data = (ir.IntType(32)(value) for value in (0, 3, 1))
        builder.call(function, [pointer, read, keep, data])
        return context.get_dummy_value()

    return types.void(rows, row), generate
