"""Camera path of a video along the input cameras."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from asysplat.export.poses import ROUNDING, checked_poses, lengths, pose_vectors, with_poses
from asysplat.rendering.reference.math import rotations
from asysplat.scene import Cameras

MAX_DETOUR = 1.5  # of the given order, over that of nearest neighbors
SAMPLES = 2000  # of a path, before it is smoothed
SMOOTHING = 0.02  # standard deviation of the Gaussian filter, over the path's length


def smoothed_path(cameras: Cameras, frames: int) -> Cameras:
    """Build a smooth path through the cameras at constant speed, from the first to the last.

    A turn of one radian counts as much as a translation by the cameras' spread. Cameras that are
    not in the order of a walk are sorted by nearest neighbors first.

    Args:
        cameras: [V], without batch dimension.
        frames: number of video frames.

    Returns:
        [frames] with the mean intrinsics, all equal if the cameras are.

    Raises:
        InputError: see `checked_poses`.
    """
    poses = checked_poses(cameras, frames)
    poses = poses[_short_order(pose_vectors(poses))]
    steps = lengths(np.diff(pose_vectors(poses), axis=0))
    moves = steps > ROUNDING
    if not moves.any():
        return with_poses(cameras, poses[:1].repeat(frames, 0))
    positions = np.append(0.0, steps[moves].cumsum())
    smoothed = _smoothed(poses[np.append(True, moves)], positions)
    positions = np.append(0.0, lengths(np.diff(pose_vectors(_rigid(smoothed)), axis=0)).cumsum())
    times = np.linspace(0, positions[-1], frames)
    evenly = np.stack([np.interp(times, positions, column) for column in smoothed.T], 1)
    return with_poses(cameras, _rigid(evenly))


def _short_order(vectors: Float[ndarray, "V 12"]) -> Int[ndarray, " V"]:
    """Return the given order, or that of nearest neighbors if it is far shorter.

    The latter starts with the view farthest from the mean, an end of the path.
    """
    given = np.arange(len(vectors))
    order = [int(lengths(vectors - vectors.mean(0)).argmax())]
    left = np.delete(given, order[0])
    while len(left):
        nearest = lengths(vectors[left] - vectors[order[-1]]).argmin()
        order.append(int(left[nearest]))
        left = np.delete(left, nearest)
    as_given, short = (lengths(np.diff(vectors[o], axis=0)).sum() for o in (given, order))
    return np.array(order) if as_given > MAX_DETOUR * short else given


def _smoothed(
    poses: Float[ndarray, "V 4 4"], positions: Float[ndarray, " V"]
) -> Float[ndarray, "samples 7"]:
    """Interpolate poses at increasing positions by splines, and smooth these.

    Returns:
        centers and quaternions wxyz of any norm.
    """
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
