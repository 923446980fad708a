"""Project Gaussians to splats, in float64 where numbers cancel, whatever the type of the inputs."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel
from asysplat.rendering import formulas, interface
from asysplat.rendering.cuda.math import (
    CAMERA,
    CX,
    CY,
    FX,
    HIGH_X,
    LOW_X,
    covariance,
    direction,
    ellipse_rows,
    load3,
    load_camera,
    project_mean,
    sh_basis,
    sum_sh,
    unit_quaternion,
    whitening,
)
from asysplat.rendering.cuda.splat import store_splat

MAX_MAGNITUDE = tl.constexpr(interface.MAX_MAGNITUDE)
WHITEN_TO_LOG2 = tl.constexpr(formulas.WHITEN_TO_LOG2)
EXPONENT_MARGIN = tl.constexpr(formulas.EXPONENT_MARGIN)
PIXEL_MARGIN = tl.constexpr(formulas.PIXEL_MARGIN)
WIDENED = tl.constexpr(1 + 3e-6)  # what float32 rounds off of an extent
COUNTERS = 2  # Gaussians culled by their opacity, and by the frustum


@kernel
def pack_cameras(cam_to_world, intrinsics, rows, height, width, MARGIN: tl.constexpr):
    """Write the row of one image; see `formulas.camera_rows`."""
    image = tl.program_id(0).to(tl.int64)
    row, pinhole, k = rows + CAMERA * image, intrinsics + 9 * image, tl.arange(0, 16)
    pose = tl.load(cam_to_world + 16 * image + 4 * (k % 3) + k // 3, mask=k < 12, other=0.0)
    tl.store(row + k, pose.to(tl.float64), mask=k < 12)
    store_axis(row, pinhole, 0, width, MARGIN)
    store_axis(row, pinhole, 1, height, MARGIN)


@kernel
def store_axis(row, pinhole, axis: tl.constexpr, pixels, MARGIN: tl.constexpr):
    """Write the focal length, the principal point and the limits of one image axis."""
    focal = tl.load(pinhole + 4 * axis).to(tl.float64)
    principal = tl.load(pinhole + 3 * axis + 2).to(tl.float64)
    margin = tl.full((), MARGIN, tl.float64) * pixels
    tl.store(row + FX + axis, focal)
    tl.store(row + CX + axis, principal)
    tl.store(row + LOW_X + 2 * axis, (-principal - margin) / focal)
    tl.store(row + HIGH_X + 2 * axis, (pixels - principal + margin) / focal)


@kernel
def project(
    means,
    quats,
    scales,
    opacities,
    sh,
    cameras,
    splats,  # written, like the next two
    depths,  # [images * num], infinite where culled
    counters,  # [programs, COUNTERS]
    num,
    views,
    height,
    width,
    alpha_min,
    log_alpha_min,
    eps2d,
    near,
    compensation_min,
    ANTIALIASED: tl.constexpr,
    CULL_OPACITY: tl.constexpr,
    CULL_FRUSTUM: tl.constexpr,
    CULL_EXTENT: tl.constexpr,
    COUNT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute the splats of BLOCK Gaussians in one image; see `cpu.project.project`."""
    image = tl.program_id(1).to(tl.int64)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    g = image // views * num + n
    opacity = tl.load(opacities + g, mask=n < num, other=0.0).to(tl.float64)
    valid = n < num
    if CULL_OPACITY:
        # NaN stays and is culled below.
        valid = valid & ((opacity >= alpha_min) | (opacity != opacity))
    culled_by_opacity = tl.sum(((n < num) & (valid == 0)).to(tl.int32), 0)
    mean, scale = load3(means, g, valid), load3(scales, g, valid)
    quat = unit_quaternion(quats, g, valid)
    camera = cameras + CAMERA * image
    axes, center, focal, limits = load_camera(camera)
    offset, z, _, tangents, _, row_x, row_y = project_mean(mean, axes, center, focal, limits)
    mx, my, _, _ = ellipse_rows(quat, scale, row_x, row_y)
    xx, xy, yy, _, det0, det = covariance(mx, my, eps2d)
    a, b, c = whitening(xy, yy + eps2d, det)
    visible = (opacity <= 1) & valid
    if ANTIALIASED:
        opacity *= tl.sqrt(tl.maximum(det0 / det, compensation_min))
    x = tangents[0] * focal[0] + tl.load(camera + CX)
    y = tangents[1] * focal[1] + tl.load(camera + CY)
    log_opacity = tl.log2(opacity.to(tl.float32))
    room = EXPONENT_MARGIN - log_alpha_min
    if CULL_EXTENT:
        room += log_opacity
    deviations = tl.sqrt(tl.maximum(room, 0.0)) * (WIDENED / WHITEN_TO_LOG2)
    extent_x = deviations * tl.sqrt((xx + eps2d).to(tl.float32))
    extent_y = deviations * tl.sqrt((yy + eps2d).to(tl.float32))
    # Comparisons with NaN are false.
    visible = visible & (z > near) & (z < MAX_MAGNITUDE) & (opacity >= alpha_min) & (a > 0)
    visible = visible & (tl.abs(x + y + b + c) < float("inf"))
    edge = 0.5 - PIXEL_MARGIN
    inside = (x + extent_x >= edge) & (x - extent_x <= width - edge)
    inside = inside & (y + extent_y >= edge) & (y - extent_y <= height - edge)
    culled_by_frustum = 0
    if CULL_FRUSTUM:
        culled_by_frustum += tl.sum((visible & (inside == 0)).to(tl.int32), 0)
        visible = visible & inside
    d = image * num + n
    if tl.max(visible.to(tl.int32), 0) > 0:
        color, visible = compute_colors(sh, g, offset, visible, COUNT)
        a, b, c = a * WHITEN_TO_LOG2, b * WHITEN_TO_LOG2, c * WHITEN_TO_LOG2
        ellipse = (x, y, a, b, c, extent_y)
        store_splat(splats, d, ellipse, log_opacity, color, z, visible)
    tl.store(depths + d, tl.where(visible, z, float("inf")).to(tl.float32), mask=n < num)
    counter = counters + 2 * (image * tl.num_programs(0) + tl.program_id(0))
    tl.store(counter, culled_by_opacity)
    tl.store(counter + 1, culled_by_frustum)


@kernel
def compute_colors(sh, g, offset, visible, COUNT: tl.constexpr):
    """Compute the colors along `offset`, and which of the `visible` have usable SH."""
    _, _, x, y, z = direction(offset)
    basis = sh_basis(x, y, z, COUNT)
    red = tl.maximum(sum_sh(sh, g, 0, basis, visible, COUNT), 0.0)
    green = tl.maximum(sum_sh(sh, g, 1, basis, visible, COUNT), 0.0)
    blue = tl.maximum(sum_sh(sh, g, 2, basis, visible, COUNT), 0.0)
    for k in tl.static_range(3 * COUNT):
        coefficient = tl.load(sh + 3 * COUNT * g + k, mask=visible, other=0.0)
        visible = visible & (tl.abs(coefficient) < MAX_MAGNITUDE)
    return (red, green, blue), visible
