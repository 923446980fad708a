"""Spherical harmonics of one direction, degree 0 to 3, with the signs of INRIA's code."""

from asysplat.ops.cpu.kernel import inline
from asysplat.rendering.formulas import Y0, Y1, Y2, Y2_0, Y3_0, Y3_1, Y3_2, Y3_3


@inline
def basis(x, y, z, count, out):
    """The first `count` (1, 4, 9 or 16) functions at a unit direction."""
    out[0] = Y0
    if count > 1:
        out[1] = -Y1 * y
        out[2] = Y1 * z
        out[3] = -Y1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        out[4] = Y2 * x * y
        out[5] = -Y2 * y * z
        out[6] = Y2_0 * (2 * zz - xx - yy)
        out[7] = -Y2 * x * z
        out[8] = 0.5 * Y2 * (xx - yy)
        if count > 9:
            out[9] = -Y3_3 * y * (3 * xx - yy)
            out[10] = Y3_2 * x * y * z
            out[11] = -Y3_1 * y * (4 * zz - xx - yy)
            out[12] = Y3_0 * z * (2 * zz - 3 * xx - 3 * yy)
            out[13] = -Y3_1 * x * (4 * zz - xx - yy)
            out[14] = 0.5 * Y3_2 * z * (xx - yy)
            out[15] = -Y3_3 * x * (xx - 3 * yy)


@inline
def basis_gradient(x, y, z, count, g):
    """Gradient of the direction from those, g, of the functions, as if x, y, z were free."""
    gx = gy = gz = 0.0
    if count > 1:
        gx, gy, gz = -Y1 * g[3], -Y1 * g[1], Y1 * g[2]
    if count > 4:
        gx += Y2 * (y * g[4] - z * g[7] + x * g[8]) - 2 * Y2_0 * x * g[6]
        gy += Y2 * (x * g[4] - z * g[5] - y * g[8]) - 2 * Y2_0 * y * g[6]
        gz += -Y2 * (y * g[5] + x * g[7]) + 4 * Y2_0 * z * g[6]
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        gx += -6 * Y3_3 * x * y * g[9] + Y3_2 * y * z * g[10] + 2 * Y3_1 * x * y * g[11]
        gx += -6 * Y3_0 * x * z * g[12] - Y3_1 * (4 * zz - 3 * xx - yy) * g[13]
        gx += Y3_2 * x * z * g[14] - 3 * Y3_3 * (xx - yy) * g[15]
        gy += -3 * Y3_3 * (xx - yy) * g[9] + Y3_2 * x * z * g[10]
        gy += -Y3_1 * (4 * zz - xx - 3 * yy) * g[11] - 6 * Y3_0 * y * z * g[12]
        gy += 2 * Y3_1 * x * y * g[13] - Y3_2 * y * z * g[14] + 6 * Y3_3 * x * y * g[15]
        gz += Y3_2 * x * y * g[10] - 8 * Y3_1 * y * z * g[11]
        gz += Y3_0 * (6 * zz - 3 * xx - 3 * yy) * g[12] - 8 * Y3_1 * x * z * g[13]
        gz += 0.5 * Y3_2 * (xx - yy) * g[14]
    return gx, gy, gz
