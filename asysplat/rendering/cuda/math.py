"""Arithmetic of the renderer's kernels: cameras, ellipses, spherical harmonics (SH).

Both projection passes share it: directions and SH in float32, the rest in the type of its inputs.
"""

from collections.abc import Callable

import triton.language as tl

from asysplat.geometry import spherical_harmonics as sh
from asysplat.kernels.triton_utils import kernel
from asysplat.rendering import formulas

RIGHT, DOWN = tl.constexpr(formulas.RIGHT), tl.constexpr(formulas.DOWN)
FORWARD, CENTER = tl.constexpr(formulas.FORWARD), tl.constexpr(formulas.CENTER)
FX, FY = tl.constexpr(formulas.FX), tl.constexpr(formulas.FY)
CX, CY = tl.constexpr(formulas.CX), tl.constexpr(formulas.CY)
LOW_X, HIGH_X = tl.constexpr(formulas.LOW_X), tl.constexpr(formulas.HIGH_X)
LOW_Y, HIGH_Y = tl.constexpr(formulas.LOW_Y), tl.constexpr(formulas.HIGH_Y)
CAMERA = tl.constexpr(formulas.CAMERA)
CAMERA_GRADIENT = tl.constexpr(formulas.CAMERA_GRADIENT)
MIN_SQUARED_DISTANCE = tl.constexpr(sh.MIN_SQUARED_DISTANCE)

SH_C0, Y1 = tl.constexpr(sh.SH_C0), tl.constexpr(sh.Y1)
Y2, Y2_0 = tl.constexpr(sh.Y2), tl.constexpr(sh.Y2_0)
Y3_0, Y3_1 = tl.constexpr(sh.Y3_0), tl.constexpr(sh.Y3_1)
Y3_2, Y3_3 = tl.constexpr(sh.Y3_2), tl.constexpr(sh.Y3_3)


@kernel
def sqrt(value):
    """Compute a square root; the shared formulas call it."""
    return tl.sqrt(value)


@kernel
def clamp(value, low, high):
    """Limit `value` to [low, high]; NaN stays."""
    return tl.where(value < low, low, tl.where(value > high, high, value))


@kernel
def select(condition, yes, no):
    """Return `yes` where the condition holds, else `no`."""
    return tl.where(condition, yes, no)


def compile_formula(formula: Callable) -> Callable:
    """Compile a shared formula with the functions of this module."""
    return kernel(formulas.bind(formula, globals()))


dot = compile_formula(formulas.dot)
cross = compile_formula(formulas.cross)
scaled = compile_formula(formulas.scaled)
plus = compile_formula(formulas.plus)
times = compile_formula(formulas.times)
rotation_columns = compile_formula(formulas.rotation_columns)
rotation_gradient = compile_formula(formulas.rotation_gradient)
project_mean = compile_formula(formulas.project_mean)
project_mean_gradient = compile_formula(formulas.project_mean_gradient)
ellipse_rows = compile_formula(formulas.ellipse_rows)
ellipse_rows_gradient = compile_formula(formulas.ellipse_rows_gradient)
covariance = compile_formula(formulas.covariance)
covariance_gradient = compile_formula(formulas.covariance_gradient)
whitening = compile_formula(formulas.whitening)


@kernel
def load1(array, index, valid):
    """Read float64 from an array, 1 where not `valid`."""
    return tl.load(array + index, mask=valid, other=1.0).to(tl.float64)


@kernel
def load3(array, row, valid):
    """Read rows of three."""
    return (
        load1(array, 3 * row, valid),
        load1(array, 3 * row + 1, valid),
        load1(array, 3 * row + 2, valid),
    )


@kernel
def load_row3(array, start):
    """Read three numbers, the same for all lanes."""
    return (tl.load(array + start), tl.load(array + start + 1), tl.load(array + start + 2))


@kernel
def store3(array, row, values, valid):
    """Write rows of three."""
    tl.store(array + 3 * row, values[0], mask=valid)
    tl.store(array + 3 * row + 1, values[1], mask=valid)
    tl.store(array + 3 * row + 2, values[2], mask=valid)


@kernel
def unit_quaternion(quats, row, valid):
    """Read quaternions; return the unit quaternions and 1 / their lengths."""
    w = load1(quats, 4 * row, valid)
    x = load1(quats, 4 * row + 1, valid)
    y = load1(quats, 4 * row + 2, valid)
    z = load1(quats, 4 * row + 3, valid)
    inverse = 1 / tl.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel
def load_camera(camera):
    """Read axes (right, down, forward), center, focal lengths and limits of the tangents."""
    axes = (load_row3(camera, RIGHT), load_row3(camera, DOWN), load_row3(camera, FORWARD))
    focal = (tl.load(camera + FX), tl.load(camera + FY))
    limits_x = (tl.load(camera + LOW_X), tl.load(camera + HIGH_X))
    limits_y = (tl.load(camera + LOW_Y), tl.load(camera + HIGH_Y))
    return axes, load_row3(camera, CENTER), focal, (limits_x, limits_y)


@kernel
def direction(offset):
    """Compute the square of an offset, its length and its direction, in float32."""
    x, y, z = offset[0].to(tl.float32), offset[1].to(tl.float32), offset[2].to(tl.float32)
    square = x * x + y * y + z * z
    length = tl.sqrt(tl.maximum(square, MIN_SQUARED_DISTANCE))
    return square, length, x / length, y / length, z / length


@kernel
def sh_basis(x, y, z, COUNT: tl.constexpr):
    """Evaluate the first COUNT (1, 4, 9 or 16) SH functions at unit directions."""
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
    """Compute the gradient of x, y and z, as independent variables, from the gradients g."""
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
def sum_sh(sh, g, channel: tl.constexpr, basis, valid, COUNT: tl.constexpr):
    """Compute 0.5 + sum_k sh_k Y_k of one channel of Gaussians g."""
    color = 0.5
    for k in tl.static_range(COUNT):
        coefficient = tl.load(sh + 3 * (COUNT * g + k) + channel, mask=valid, other=0.0)
        color += basis[k] * coefficient.to(tl.float32)
    return color
