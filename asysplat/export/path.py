"""Cameras of a video along the photographs' own way."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from asysplat.export.poses import SAME, checked_poses, features, lengths, with_poses
from asysplat.rendering.reference.math import rotations
from asysplat.scene import Cameras

JUMPING = 1.5  # times the shorter way: then the views' order is not that of a walk
SAMPLES = 2000  # of a way, before it is smoothed
SMOOTHING = 0.02  # of a way's length: the Gaussian filter's standard deviation


def smoothed_path(cameras: Cameras, frames: int) -> Cameras:
    """Follow the cameras' own way, smoothly and at constant speed, from the first to the last.

    Turns take time too: one radian as much as a way of the cameras' spread. Views whose order
    jumps about are first brought into one that is a short way.

    Args:
        cameras: [V], without batch dimension.
        frames: of the video.

    Returns:
        [frames] with the mean intrinsics, all alike where the cameras are.

    Raises:
        InputError: a batch dimension, no views, no frames, or what `Cameras.validate` refuses.
    """
    poses = checked_poses(cameras, frames)
    poses = poses[_short_order(features(poses))]
    steps = lengths(np.diff(features(poses), axis=0))
    moves = steps > SAME
    if not moves.any():
        return with_poses(cameras, poses[:1].repeat(frames, 0))
    way = np.append(0.0, steps[moves].cumsum())
    smooth = _smoothed(poses[np.append(True, moves)], way)
    way = np.append(0.0, lengths(np.diff(features(_rigid(smooth)), axis=0)).cumsum())
    times = np.linspace(0, way[-1], frames)
    evenly = np.stack([np.interp(times, way, column) for column in smooth.T], 1)
    return with_poses(cameras, _rigid(evenly))


def _short_order(features: Float[ndarray, "V 12"]) -> Int[ndarray, " V"]:
    """Return the given order, or that of nearest neighbors if it is far shorter.

    This starts with the view that is farthest from the mean: an end of the way.
    """
    given = np.arange(len(features))
    order = [int(lengths(features - features.mean(0)).argmax())]
    left = np.delete(given, order[0])
    while len(left):
        nearest = lengths(features[left] - features[order[-1]]).argmin()
        order.append(int(left[nearest]))
        left = np.delete(left, nearest)
    as_given, short = (lengths(np.diff(features[o], axis=0)).sum() for o in (given, order))
    return np.array(order) if as_given > JUMPING * short else given


def _smoothed(
    poses: Float[ndarray, "V 4 4"], way: Float[ndarray, " V"]
) -> Float[ndarray, "samples 7"]:
    """Lay splines through poses and smooth them.

    Args:
        way: from the first pose to each, increasing.

    Returns:
        centers and quaternions wxyz of any length, close together.
    """
    # Here, as these would slow down import asysplat.
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation, RotationSpline

    samples = np.linspace(0, way[-1], SAMPLES)
    centers = CubicSpline(way, poses[:, :3, 3])(samples)
    quats = RotationSpline(way, Rotation.from_matrix(poses[:, :3, :3]))(samples)
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
