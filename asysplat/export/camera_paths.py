"""Camera paths of videos: along the input cameras, or around the scene."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from asysplat.errors import InputError
from asysplat.geometry.motion import rotations
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

HEIGHT, WIDTH = 4, 16  # pixels of a look outward, which is flat, as the ground is no wall
FOCAL = 16.0  # pixels: 27 degrees to either side, 7 up and down
CLEARANCE = 0.5  # fraction of the way to a wall that may be gone
WINDOW = 0.05  # fraction of the frames, before and after a wall, in which a path evades it


def free_radii(
    gaussians: Gaussians,
    outward: Float[ndarray, "T 4 4"],
    starts: Float[ndarray, " T"],
    radius: float,
) -> Float[ndarray, " T"]:
    """Compute the radii of a closed path that smoothly evades walls, `radius` where it meets none.

    A wall is the first that a look `outward` (cam_to_world) meets with half of the opacity, in any
    pixel. The looks are from points of free space, whose radii are `starts`.
    """
    # Here, as it would slow down import asysplat.
    from scipy.ndimage import minimum_filter1d, uniform_filter1d

    poses = torch.from_numpy(outward).to(gaussians.means)
    lens = poses.new_tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    looks = Cameras(lens.expand(len(poses), 3, 3), poses, HEIGHT, WIDTH)
    with torch.no_grad():
        depths = render(gaussians, looks, depth="median", views_at_once=1).depth
    ways = torch.where(depths > 0, depths, torch.inf).amin((-2, -1)).cpu().double().numpy()
    radii = np.minimum(radius, starts + CLEARANCE * ways)
    if (radii == radius).all():
        return radii
    half = max(1, round(WINDOW * len(radii)))
    radii = minimum_filter1d(radii, 2 * half + 1, mode="wrap")
    for _ in range(2):  # both together within the minimum's window: no radius exceeds its bound
        radii = uniform_filter1d(radii, half + 1 - half % 2, mode="wrap")
    return radii


ROUNDING = 1e-6  # relative to coordinates, or in radians; smaller differences are rounding
# Paths along the cameras.
MAX_DETOUR = 1.5  # greatest length of the given order, over that of nearest neighbors
SAMPLES = 2000  # samples of a path, before it is smoothed
SMOOTHING = 0.02  # standard deviation of the Gaussian filter, over the path's length
# Orbits.
PARALLEL = 0.01  # mean squared angle between axes and their mean, below it parallel: 6 degrees
FOCUS_DISTANCE = 4.0  # in spreads of the cameras, if their axes do not meet
MIN_UP_COSINE = 0.5  # between the world's up and the cameras' mean up: 60 degrees
MAX_GAP = np.radians(90)  # between neighbors on a full circle
MIN_SWING = np.radians(5)  # to either side
MAX_STEEPNESS = 10.0  # distance over radius, so that no camera looks straight down
SAME_DIRECTION = 0.2  # radians from the focus, more than the nearest direction


def smoothed_path(cameras: Cameras, frames: int, as_given: bool = False) -> Cameras:
    """Build a smooth path through the cameras at constant speed, from the first to the last.

    A turn of one radian counts as much as a translation by the cameras' spread.

    Args:
        cameras: [V], without batch dimension.
        frames: number of video frames.
        as_given: order of the cameras kept; else those that are not in the order of a walk are
            sorted by nearest neighbors first.

    Returns:
        [frames] with the mean intrinsics, all equal if the cameras are.

    Raises:
        InputError: a batch dimension, no views, no frames, or see `Cameras.validate`.
    """
    poses = _checked_poses(cameras, frames)
    if not as_given:
        poses = poses[_short_order(_pose_vectors(poses))]
    steps = _lengths(np.diff(_pose_vectors(poses), axis=0))
    moves = steps > ROUNDING
    if not moves.any():
        return _with_poses(cameras, poses[:1].repeat(frames, 0))
    positions = np.append(0.0, steps[moves].cumsum())
    smoothed = _smoothed(poses[np.append(True, moves)], positions)
    positions = np.append(0.0, _lengths(np.diff(_pose_vectors(_rigid(smoothed)), axis=0)).cumsum())
    times = np.linspace(0, positions[-1], frames)
    evenly = np.stack([np.interp(times, positions, column) for column in smoothed.T], 1)
    return _with_poses(cameras, _rigid(evenly))


def _short_order(vectors: Float[ndarray, "V 12"]) -> Int[ndarray, " V"]:
    """Choose the original order, or that of nearest neighbors if it is far shorter."""
    original = np.arange(len(vectors))
    # It starts with the view farthest from the mean, an end of the path.
    order = [int(_lengths(vectors - vectors.mean(0)).argmax())]
    remaining = np.delete(original, order[0])
    while len(remaining):
        nearest = _lengths(vectors[remaining] - vectors[order[-1]]).argmin()
        order.append(int(remaining[nearest]))
        remaining = np.delete(remaining, nearest)
    length, shortcut = (_lengths(np.diff(vectors[o], axis=0)).sum() for o in (original, order))
    return np.array(order) if length > MAX_DETOUR * shortcut else original


def _smoothed(
    poses: Float[ndarray, "V 4 4"], positions: Float[ndarray, " V"]
) -> Float[ndarray, "samples 7"]:
    """Interpolate poses by splines, smoothed, as centers and quaternions wxyz of any norm."""
    # Here, as they would slow down import asysplat.
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation, RotationSpline

    samples = np.linspace(0, positions[-1], SAMPLES)
    centers = CubicSpline(positions, poses[:, :3, 3])(samples)
    quats = RotationSpline(positions, Rotation.from_matrix(poses[:, :3, :3]))(samples)
    quats = quats.as_quat(scalar_first=True)
    # q and -q are the same rotation: neighbors get the same sign.
    flips = (quats[1:] * quats[:-1]).sum(1) < 0
    quats[1:] *= np.where(flips, -1, 1).cumprod()[:, None]
    states = np.concatenate((centers, quats), 1)
    return gaussian_filter1d(states, SMOOTHING * SAMPLES, axis=0, mode="nearest")


def _rigid(states: Float[ndarray, "T 7"]) -> Float[ndarray, "T 4 4"]:
    poses = np.tile(np.eye(4), (len(states), 1, 1))
    poses[:, :3, :3] = rotations(torch.from_numpy(states[:, 3:])).numpy()
    poses[:, :3, 3] = states[:, :3]
    return poses


def orbit(
    cameras: Cameras,
    frames: int,
    focus: Float[Tensor, "3"] | None = None,
    gaussians: Gaussians | None = None,
) -> Cameras:
    """Build a closed path around the focus point, at the cameras' mean height.

    A full circle if the cameras are all around, else to and fro within their arc, as other sides of
    the scene are unobserved. It is as far from the point as nine in ten cameras are at most, so
    that what they show is in frame; nearer where a wall of the scene is in between.

    Args:
        cameras: [V], without batch dimension.
        frames: number of video frames.
        focus: the subject; None: where the optical axes meet, which may be behind it.
        gaussians: scene, whose walls the path evades; None: it evades none.

    Returns:
        [frames] upright cameras that look at the point, with the mean intrinsics.

    Raises:
        InputError: a batch dimension, no views, no frames, or see `Cameras.validate`.
    """
    poses = _checked_poses(cameras, frames)
    vectors = _pose_vectors(poses)
    middle = int(_lengths(vectors - vectors.mean(0)).argmin())
    focus = _focus(poses, cameras, middle) if focus is None else focus.cpu().double().numpy()
    visible = _visible(focus, poses, cameras)
    visible[middle] = True
    up = _up(poses, middle)
    offsets = poses[visible, :3, 3] - focus
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    lowest = _lengths(offsets).mean() / MAX_STEEPNESS
    radius = max(np.quantile(_lengths(flat), 0.9), lowest)
    direction = poses[middle, :3, 3] - focus
    x = direction - (direction @ up) * up
    if np.linalg.norm(x) < ROUNDING * np.linalg.norm(direction):
        x = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    azimuths = np.arctan2(flat @ y, flat @ x)
    angles = _angles(azimuths, frames)
    circle = np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
    center = focus + heights.mean() * up
    radii = np.full(frames, radius)
    if gaussians is not None:
        # Space is free at the input cameras: a look starts as far out as the nearest of those in
        # about its direction.
        apart = np.abs((angles[:, None] - azimuths + np.pi) % (2 * np.pi) - np.pi)
        alike = apart <= apart.min(1, keepdims=True) + SAME_DIRECTION
        starts = np.where(alike, _lengths(flat), np.inf).min(1).clip(lowest, radius)
        outward = _looks(center + starts[:, None] * circle, circle, up)
        radii = free_radii(gaussians, outward, starts, radius)
    centers = center + radii[:, None] * circle
    return _with_poses(cameras, _looks(centers, focus - centers, up))


def _looks(
    centers: Float[ndarray, "T 3"], forward: Float[ndarray, "T 3"], up: Float[ndarray, "3"]
) -> Float[ndarray, "T 4 4"]:
    right = np.cross(forward, up)
    axes = np.stack((right, np.cross(forward, right), forward), 2)
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    poses[:, :3, 3] = centers
    return poses


def _up(poses: Float[ndarray, "V 4 4"], middle: int) -> Float[ndarray, "3"]:
    """Return what is perpendicular to all x axes, as horizons are level; else the mean up."""
    right, up = poses[:, :3, 0], -poses[:, :3, 1].mean(0)
    if np.linalg.norm(up) < ROUNDING:  # they cancel
        up = -poses[middle, :3, 1]
    up /= np.linalg.norm(up)
    variances, directions = np.linalg.eigh(right.T @ right / len(right))
    across = directions[:, 0] * np.sign(directions[:, 0] @ up)
    return across if variances[1] > PARALLEL and across @ up > MIN_UP_COSINE else up


def _focus(poses: Float[ndarray, "V 4 4"], cameras: Cameras, middle: int) -> Float[ndarray, "3"]:
    """Return the point nearest to all optical axes, or one in front of the middle camera.

    The latter if the axes are nearly parallel, or their point is not visible in most views.
    """
    centers, axes, size = poses[:, :3, 3], poses[:, :3, 2], _spread(poses)
    if size:
        across = np.eye(3) - axes[:, :, None] * axes[:, None]
        matrix = across.mean(0)
        if np.linalg.eigvalsh(matrix)[0] > PARALLEL:
            point = np.linalg.solve(matrix, np.einsum("vij,vj->i", across, centers) / len(poses))
            if _visible(point, poses, cameras).mean() > 0.5:
                return point
    return centers[middle] + (FOCUS_DISTANCE * size or 1.0) * axes[middle]


def _visible(
    point: Float[ndarray, "3"], poses: Float[ndarray, "V 4 4"], cameras: Cameras
) -> Bool[ndarray, " V"]:
    exact = replace(cameras.to("cpu", torch.float64), cam_to_world=torch.from_numpy(poses))
    _, _, inside = exact.project(torch.from_numpy(point[None]))
    return inside[:, 0].detach().numpy()


def _angles(angles: Float[ndarray, " S"], frames: int) -> Float[ndarray, " T"]:
    """Return the frames' angles: a full circle, or to and fro over the cameras' arc."""
    turn = 2 * np.pi * np.arange(frames) / frames
    angles = np.sort(angles)
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = gaps.argmax()
    if gaps[widest] < MAX_GAP:
        return turn
    swing = (2 * np.pi - gaps[widest]) / 2
    middle = angles[widest] + gaps[widest] + swing
    return middle + max(swing, MIN_SWING) * np.sin(turn)


def _checked_poses(cameras: Cameras, frames: int) -> Float[ndarray, "V 4 4"]:
    if cameras.intrinsics.ndim != 3 or cameras.num_views == 0:
        raise InputError(
            f"Cameras.intrinsics has shape {tuple(cameras.intrinsics.shape)}: expected [V, 3, 3] "
            "of one scene, with one view or more."
        )
    if frames < 1:
        raise InputError(f"frames is {frames}: give 1 or more.")
    return cameras.validate().cam_to_world.detach().cpu().double().numpy()


def _with_poses(cameras: Cameras, poses: Float[ndarray, "T 4 4"]) -> Cameras:
    return replace(
        cameras,
        intrinsics=cameras.intrinsics.mean(0).repeat(len(poses), 1, 1),
        cam_to_world=torch.from_numpy(poses).to(cameras.cam_to_world),
    )


def _spread(poses: Float[ndarray, "V 4 4"]) -> float:
    """Return the RMS distance of the centers from their mean, 0 if it is rounding."""
    centers = poses[:, :3, 3]
    size = float(np.sqrt(np.square(centers - centers.mean(0)).sum(1).mean()))
    return size if size > ROUNDING * np.abs(centers).max() else 0.0


def _pose_vectors(poses: Float[ndarray, "V 4 4"]) -> Float[ndarray, "V 12"]:
    size = _spread(poses)
    centers = poses[:, :3, 3] / size if size else np.zeros((len(poses), 3))
    return np.concatenate((centers, poses[:, :3, :3].reshape(-1, 9) / np.sqrt(2)), 1)


def _lengths(vectors: Float[ndarray, "T D"]) -> Float[ndarray, " T"]:
    return np.linalg.norm(vectors, axis=1)
