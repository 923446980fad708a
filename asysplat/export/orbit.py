"""Cameras of a video around what the photographs show."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from asysplat.export.poses import SAME, checked_poses, features, lengths, spread, with_poses
from asysplat.scene import Cameras

PARALLEL = 0.01  # mean square of the angles between axes and their mean: 6 degrees
AHEAD = 4.0  # times the cameras' spread: how far what they show is, where axes do not tell
MOST_TILTED = 0.5  # the cosine between the world's up and the cameras' mean up: 60 degrees
WIDEST_GAP = np.radians(90)  # between neighbors on a circle that is seen from all around
LEAST_SWING = np.radians(5)  # to either side
STEEPEST = 10.0  # times the radius: a distance from which no camera looks straight down


def orbit(cameras: Cameras, frames: int) -> Cameras:
    """Go around the point that the cameras look at, at their mean height and distance.

    In a full circle where the cameras stand all around, else to and fro within the arc that they
    span: nothing was seen from elsewhere. After the last frame comes the first.

    Args:
        cameras: [V], without batch dimension.
        frames: of the video.

    Returns:
        [frames] that look at the point, upright, with the mean intrinsics.

    Raises:
        InputError: a batch dimension, no views, no frames, or what `Cameras.validate` refuses.
    """
    poses = checked_poses(cameras, frames)
    apart = features(poses)
    middle = int(lengths(apart - apart.mean(0)).argmin())
    focus = _focus(poses, cameras, middle)
    sees = _sees(focus, poses, cameras)
    sees[middle] = True
    up = _up(poses, middle)
    offsets = poses[sees, :3, 3] - focus
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radius = max(lengths(flat).mean(), lengths(offsets).mean() / STEEPEST)
    x, y = _axes_across(up, poses[middle, :3, 3] - focus)
    angles = _angles(np.arctan2(flat @ y, flat @ x), frames)[:, None]
    circle = radius * (np.cos(angles) * x + np.sin(angles) * y)
    return with_poses(cameras, _looking_at(focus, focus + heights.mean() * up + circle, up))


def _up(poses: Float[ndarray, "V 4 4"], middle: int) -> Float[ndarray, "3"]:
    """Return the direction that is upwards in the world.

    Photographs are taken with a level horizon, however far the camera looks down: up is across all
    cameras' x axes. Where those do not tell, it is the cameras' mean up.
    """
    right, up = poses[:, :3, 0], -poses[:, :3, 1].mean(0)
    if np.linalg.norm(up) < SAME:  # they cancel
        up = -poses[middle, :3, 1]
    up /= np.linalg.norm(up)
    spreads, directions = np.linalg.eigh(right.T @ right / len(right))
    across = directions[:, 0] * np.sign(directions[:, 0] @ up)
    return across if spreads[1] > PARALLEL and across @ up > MOST_TILTED else up


def _focus(poses: Float[ndarray, "V 4 4"], cameras: Cameras, middle: int) -> Float[ndarray, "3"]:
    """Return the point nearest to all optical axes, if most cameras see it.

    Else one in front of the middle camera: axes that are nearly parallel, or meet where the
    cameras stand or behind them, do not tell how far away things are.
    """
    centers, axes, size = poses[:, :3, 3], poses[:, :3, 2], spread(poses)
    if size:
        across = np.eye(3) - axes[:, :, None] * axes[:, None]
        matrix = across.mean(0)
        if np.linalg.eigvalsh(matrix)[0] > PARALLEL:
            point = np.linalg.solve(matrix, np.einsum("vij,vj->i", across, centers) / len(poses))
            if _sees(point, poses, cameras).mean() > 0.5:
                return point
    return centers[middle] + (AHEAD * size or 1.0) * axes[middle]


def _sees(
    point: Float[ndarray, "3"], poses: Float[ndarray, "V 4 4"], cameras: Cameras
) -> Bool[ndarray, " V"]:
    """Tell which cameras have a point in their image."""
    inside = np.einsum("vij,vi->vj", poses[:, :3, :3], point - poses[:, :3, 3])
    intrinsics = cameras.intrinsics.detach().cpu().double().numpy()
    x, y, depth = np.einsum("vij,vj->iv", intrinsics, inside)
    in_width = (x >= 0) & (x <= cameras.width * depth)
    return (depth > 0) & in_width & (y >= 0) & (y <= cameras.height * depth)


def _axes_across(
    up: Float[ndarray, "3"], direction: Float[ndarray, "3"]
) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    """Return two unit vectors across `up` and each other; the first is nearest to a direction."""
    x = direction - (direction @ up) * up
    if np.linalg.norm(x) < SAME * np.linalg.norm(direction):
        x = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    x /= np.linalg.norm(x)
    return x, np.cross(up, x)


def _angles(seen: Float[ndarray, " S"], frames: int) -> Float[ndarray, " T"]:
    """Return the frames' angles: all around, or to and fro between those that were seen from."""
    turn = 2 * np.pi * np.arange(frames) / frames
    seen = np.sort(seen)
    gaps = np.diff(seen, append=seen[0] + 2 * np.pi)
    widest = gaps.argmax()
    if gaps[widest] < WIDEST_GAP:
        return turn
    swing = (2 * np.pi - gaps[widest]) / 2
    middle = seen[widest] + gaps[widest] + swing
    return middle + max(swing, LEAST_SWING) * np.sin(turn)


def _looking_at(
    point: Float[ndarray, "3"], centers: Float[ndarray, "T 3"], up: Float[ndarray, "3"]
) -> Float[ndarray, "T 4 4"]:
    forward = point - centers
    right = np.cross(forward, up)
    axes = np.stack((right, np.cross(forward, right), forward), 2)
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    poses[:, :3, 3] = centers
    return poses
