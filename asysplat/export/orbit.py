"""Camera path of a video that orbits the scene."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from asysplat.export.poses import ROUNDING, checked_poses, lengths, pose_vectors, spread, with_poses
from asysplat.scene import Cameras

PARALLEL = 0.01  # mean squared angle between axes and their mean, below it parallel: 6 degrees
FOCUS_DISTANCE = 4.0  # in spreads of the cameras, if their axes do not meet
MIN_UP_COSINE = 0.5  # between the world's up and the cameras' mean up: 60 degrees
MAX_GAP = np.radians(90)  # between neighbors on a full circle
MIN_SWING = np.radians(5)  # to either side
MAX_STEEPNESS = 10.0  # distance over radius, so that no camera looks straight down


def orbit(cameras: Cameras, frames: int) -> Cameras:
    """Build a closed path around the focus point, at the cameras' mean height and distance.

    A full circle if the cameras are all around, else to and fro within their arc, as other sides of
    the scene are unobserved.

    Args:
        cameras: [V], without batch dimension.
        frames: number of video frames.

    Returns:
        [frames] upright cameras that look at the point, with the mean intrinsics.

    Raises:
        InputError: see `checked_poses`.
    """
    poses = checked_poses(cameras, frames)
    vectors = pose_vectors(poses)
    middle = int(lengths(vectors - vectors.mean(0)).argmin())
    focus = _focus(poses, cameras, middle)
    visible = _visible(focus, poses, cameras)
    visible[middle] = True
    up = _up(poses, middle)
    offsets = poses[visible, :3, 3] - focus
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radius = max(lengths(flat).mean(), lengths(offsets).mean() / MAX_STEEPNESS)
    direction = poses[middle, :3, 3] - focus
    x = direction - (direction @ up) * up
    if np.linalg.norm(x) < ROUNDING * np.linalg.norm(direction):
        x = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    angles = _angles(np.arctan2(flat @ y, flat @ x), frames)[:, None]
    circle = radius * (np.cos(angles) * x + np.sin(angles) * y)
    centers = focus + heights.mean() * up + circle
    forward = focus - centers
    right = np.cross(forward, up)
    axes = np.stack((right, np.cross(forward, right), forward), 2)
    path = np.tile(np.eye(4), (frames, 1, 1))
    path[:, :3, :3] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    path[:, :3, 3] = centers
    return with_poses(cameras, path)


def _up(poses: Float[ndarray, "V 4 4"], middle: int) -> Float[ndarray, "3"]:
    """Return the world's up direction.

    Photographers keep the horizon level, so that up is perpendicular to all cameras' x axes. If
    these are parallel, up is the cameras' mean up.
    """
    right, up = poses[:, :3, 0], -poses[:, :3, 1].mean(0)
    if np.linalg.norm(up) < ROUNDING:  # they cancel
        up = -poses[middle, :3, 1]
    up /= np.linalg.norm(up)
    variances, directions = np.linalg.eigh(right.T @ right / len(right))
    across = directions[:, 0] * np.sign(directions[:, 0] @ up)
    return across if variances[1] > PARALLEL and across @ up > MIN_UP_COSINE else up


def _focus(poses: Float[ndarray, "V 4 4"], cameras: Cameras, middle: int) -> Float[ndarray, "3"]:
    """Return the point nearest to all optical axes, if it is visible in most views.

    Otherwise (axes nearly parallel, or meeting at or behind the cameras) return a point in front of
    the middle camera.
    """
    centers, axes, size = poses[:, :3, 3], poses[:, :3, 2], spread(poses)
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
    """Check which cameras show a point."""
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
