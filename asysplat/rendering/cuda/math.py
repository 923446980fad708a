"""Arithmetic of the renderer's kernels: cameras, ellipses, spherical harmonics (SH).

All that the two projection passes share is here: SH in float32, the rest in float64.
"""

import inspect
from collections.abc import Callable
from types import FunctionType

import triton.language as tl

from asysplat.ops.triton_utils import kernel
from asysplat.rendering import formulas, interface, sh

RIGHT, DOWN = tl.constexpr(formulas.RIGHT), tl.constexpr(formulas.DOWN)
FORWARD, CENTER = tl.constexpr(formulas.FORWARD), tl.constexpr(formulas.CENTER)
FX, FY = tl.constexpr(formulas.FX), tl.constexpr(formulas.FY)
CX, CY = tl.constexpr(formulas.CX), tl.constexpr(formulas.CY)
LOW_X, HIGH_X = tl.constexpr(formulas.LOW_X), tl.constexpr(formulas.HIGH_X)
LOW_Y, HIGH_Y = tl.constexpr(formulas.LOW_Y), tl.constexpr(formulas.HIGH_Y)
CAMERA = tl.constexpr(formulas.CAMERA)
CAMERA_GRADIENT = tl.constexpr(formulas.CAMERA_GRADIENT)
MIN_SQUARED_DISTANCE = tl.constexpr(interface.MIN_SQUARED_DISTANCE)

SH_C0, Y1 = tl.constexpr(sh.SH_C0), tl.constexpr(sh.Y1)
Y2, Y2_0 = tl.constexpr(sh.Y2), tl.constexpr(sh.Y2_0)
Y3_0, Y3_1 = tl.constexpr(sh.Y3_0), tl.constexpr(sh.Y3_1)
Y3_2, Y3_3 = tl.constexpr(sh.Y3_2), tl.constexpr(sh.Y3_3)


def shared(formula: Callable) -> Callable:
    """Compile; Triton wants to see its language among the names that a function knows."""
    bare = inspect.unwrap(formula)
    return kernel(FunctionType(bare.__code__, {"__name__": __name__, "tl": tl}))


dot = shared(formulas.dot)
cross = shared(formulas.cross)
scaled = shared(formulas.scaled)
plus = shared(formulas.plus)
times = shared(formulas.times)
rotation_columns = shared(formulas.rotation_columns)
rotation_gradient = shared(formulas.rotation_gradient)


@kernel
def load1(array, index, there):
    """Read float64 from an array, 1 where not `there`."""
    return tl.load(array + index, mask=there, other=1.0).to(tl.float64)


@kernel
def load3(array, row, there):
    """Read rows of three."""
    return (
        load1(array, 3 * row, there),
        load1(array, 3 * row + 1, there),
        load1(array, 3 * row + 2, there),
    )


@kernel
def load_row3(array, start):
    """Read three numbers that are the same for all."""
    return (tl.load(array + start), tl.load(array + start + 1), tl.load(array + start + 2))


@kernel
def store3(array, row, values, there):
    """Write rows of three."""
    tl.store(array + 3 * row, values[0], mask=there)
    tl.store(array + 3 * row + 1, values[1], mask=there)
    tl.store(array + 3 * row + 2, values[2], mask=there)


@kernel
def unit_quaternion(quats, row, there):
    """Read quaternions; return the unit quaternions and 1 / their lengths."""
    w = load1(quats, 4 * row, there)
    x = load1(quats, 4 * row + 1, there)
    y = load1(quats, 4 * row + 2, there)
    z = load1(quats, 4 * row + 3, there)
    inverse = 1 / tl.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel
def clamp(value, low, high):
    """Limit `value` to [low, high]; NaN stays."""
    return tl.where(value < low, low, tl.where(value > high, high, value))


@kernel
def in_camera(camera, mean):
    """Project means and linearize the projection around them.

    Return the offset from the camera's center, in world axes; x / z, y / z, z, 1 / z in the
    camera's frame; the tangents that the Jacobian is taken at, and its rows in world axes.
    """
    right, down = load_row3(camera, RIGHT), load_row3(camera, DOWN)
    forward, center = load_row3(camera, FORWARD), load_row3(camera, CENTER)
    # Relative to the camera first: exact for scenes far from the origin.
    offset = plus(mean, -1.0, center)
    z = dot(forward, offset)
    inverse_z = 1 / z
    tangent_x, tangent_y = dot(right, offset) * inverse_z, dot(down, offset) * inverse_z
    inside_x = clamp(tangent_x, tl.load(camera + LOW_X), tl.load(camera + HIGH_X))
    inside_y = clamp(tangent_y, tl.load(camera + LOW_Y), tl.load(camera + HIGH_Y))
    row_x = scaled(tl.load(camera + FX) * inverse_z, plus(right, -inside_x, forward))
    row_y = scaled(tl.load(camera + FY) * inverse_z, plus(down, -inside_y, forward))
    return offset, tangent_x, tangent_y, z, inverse_z, inside_x, inside_y, row_x, row_y


@kernel
def ellipse_rows(quat, scale, row_x, row_y):
    """Return the rows of M in the covariance M M^T, in pixels, after and before they are scaled."""
    axis0, axis1, axis2 = rotation_columns(quat[0], quat[1], quat[2], quat[3])
    turned_x = (dot(row_x, axis0), dot(row_x, axis1), dot(row_x, axis2))
    turned_y = (dot(row_y, axis0), dot(row_y, axis1), dot(row_y, axis2))
    return times(turned_x, scale), times(turned_y, scale), turned_x, turned_y


@kernel
def covariance(mx, my, eps):
    """Return xx, xy, yy of M M^T; M's minors; the determinants of M M^T and of M M^T + eps I.

    The determinant is the sum of the squared minors (Cauchy-Binet): no needle makes it cancel.
    """
    xx, xy, yy = dot(mx, mx), dot(mx, my), dot(my, my)
    minors = cross(mx, my)
    det0 = dot(minors, minors)
    return xx, xy, yy, minors, det0, det0 + eps * (xx + yy) + eps * eps


@kernel
def whitening(xy, var_y, det):
    """Return a, b, c of the exponent ((a dx + b dy)^2 + (c dy)^2) / 2."""
    a = tl.sqrt(var_y / det)
    return a, -a * xy / var_y, 1 / tl.sqrt(var_y)


@kernel
def direction(offset):
    """Return the square of an offset, its length, and its direction, in float32."""
    square = dot(offset, offset)
    length = tl.sqrt(tl.maximum(square, MIN_SQUARED_DISTANCE))
    x, y, z = offset[0] / length, offset[1] / length, offset[2] / length
    return square, length, x.to(tl.float32), y.to(tl.float32), z.to(tl.float32)


@kernel
def sh_basis(x, y, z, COUNT: tl.constexpr):
    """Return the first COUNT (1, 4, 9 or 16) SH functions at unit directions.

    Signs are those of INRIA's code.
    """
    out = (tl.full(x.shape, SH_C0, tl.float32),)
    if COUNT > 1:
        out = out + (y * -Y1, z * Y1, x * -Y1)
    if COUNT > 4:
        xx, yy, zz = x * x, y * y, z * z
        out = out + (x * y * Y2, y * z * -Y2, (2 * zz - xx - yy) * Y2_0, x * z * -Y2)
        out = out + ((xx - yy) * (0.5 * Y2),)
        if COUNT > 9:
            out = out + (y * (3 * xx - yy) * -Y3_3, x * y * z * Y3_2)
            out = out + (y * (4 * zz - xx - yy) * -Y3_1, z * (2 * zz - 3 * xx - 3 * yy) * Y3_0)
            out = out + (x * (4 * zz - xx - yy) * -Y3_1,)
            out = out + (z * (xx - yy) * (0.5 * Y3_2), x * (xx - 3 * yy) * -Y3_3)
    return out


@kernel
def sh_basis_gradient(x, y, z, g, COUNT: tl.constexpr):
    """Return the gradient of x, y, z, as if they were free, from those, g, of `sh_basis`."""
    gx, gy, gz = g[3] * -Y1, g[1] * -Y1, g[2] * Y1
    if COUNT > 4:
        gx += (y * g[4] - z * g[7] + x * g[8]) * Y2 - x * g[6] * (2 * Y2_0)
        gy += (x * g[4] - z * g[5] - y * g[8]) * Y2 - y * g[6] * (2 * Y2_0)
        gz += (y * g[5] + x * g[7]) * -Y2 + z * g[6] * (4 * Y2_0)
    if COUNT > 9:
        xx, yy, zz = x * x, y * y, z * z
        gx += x * y * (g[11] * (2 * Y3_1) - g[9] * (6 * Y3_3)) + y * z * g[10] * Y3_2
        gx += x * z * (g[14] * Y3_2 - g[12] * (6 * Y3_0))
        gx += (4 * zz - 3 * xx - yy) * g[13] * -Y3_1 - (xx - yy) * g[15] * (3 * Y3_3)
        gy += x * y * (g[13] * (2 * Y3_1) + g[15] * (6 * Y3_3)) + x * z * g[10] * Y3_2
        gy += y * z * (g[14] * -Y3_2 - g[12] * (6 * Y3_0))
        gy += (4 * zz - xx - 3 * yy) * g[11] * -Y3_1 - (xx - yy) * g[9] * (3 * Y3_3)
        gz += x * y * g[10] * Y3_2 + (xx - yy) * g[14] * (0.5 * Y3_2)
        gz += (2 * zz - xx - yy) * g[12] * (3 * Y3_0) - z * (y * g[11] + x * g[13]) * (8 * Y3_1)
    return gx, gy, gz


@kernel
def sum_sh(sh, g, channel: tl.constexpr, functions, there, COUNT: tl.constexpr):
    """Compute 0.5 + sum_k sh_k Y_k of one channel of Gaussians g."""
    color = 0.5
    for k in tl.static_range(COUNT):
        coefficient = tl.load(sh + 3 * (COUNT * g + k) + channel, mask=there, other=0.0)
        color += functions[k] * coefficient.to(tl.float32)
    return color
