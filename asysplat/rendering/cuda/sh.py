"""Spherical harmonics of directions, degree 0 to 3, with the signs of INRIA's code; in float32."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel
from asysplat.rendering import formulas

Y0, Y1 = tl.constexpr(formulas.Y0), tl.constexpr(formulas.Y1)
Y2, Y2_0 = tl.constexpr(formulas.Y2), tl.constexpr(formulas.Y2_0)
Y3_0, Y3_1 = tl.constexpr(formulas.Y3_0), tl.constexpr(formulas.Y3_1)
Y3_2, Y3_3 = tl.constexpr(formulas.Y3_2), tl.constexpr(formulas.Y3_3)


@kernel
def basis(x, y, z, COUNT: tl.constexpr):
    """The first COUNT (1, 4, 9 or 16) functions at unit directions."""
    out = (tl.full(x.shape, Y0, tl.float32),)
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
def basis_gradient(x, y, z, g, COUNT: tl.constexpr):
    """Gradient of the direction from those, g, of the functions, as if x, y, z were free."""
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
def sum_harmonics(sh, g, channel: tl.constexpr, functions, there, COUNT: tl.constexpr):
    """0.5 + sum_k sh_k Y_k of one channel of Gaussians g."""
    color = 0.5
    for k in tl.static_range(COUNT):
        coefficient = tl.load(sh + 3 * (COUNT * g + k) + channel, mask=there, other=0.0)
        color += functions[k] * coefficient.to(tl.float32)
    return color
