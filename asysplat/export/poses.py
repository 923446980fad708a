"""Camera poses in float64 and distances between them, for camera paths."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from asysplat.errors import InputError
from asysplat.scene import Cameras

ROUNDING = 1e-6  # relative to coordinates, or in radians; smaller differences are rounding


def checked_poses(cameras: Cameras, frames: int) -> Float[ndarray, "V 4 4"]:
    """Return the cam_to_world of the cameras of one scene, after checks for a path.

    Raises:
        InputError: a batch dimension, no views, no frames, or what `Cameras.validate` refuses.
    """
    if cameras.intrinsics.ndim != 3 or cameras.num_views == 0:
        raise InputError(
            f"Cameras.intrinsics has shape {tuple(cameras.intrinsics.shape)}: expected [V, 3, 3] "
            "of one scene, with one view or more."
        )
    if frames < 1:
        raise InputError(f"frames is {frames}: give 1 or more.")
    return cameras.validate().cam_to_world.detach().cpu().double().numpy()


def with_poses(cameras: Cameras, poses: Float[ndarray, "T 4 4"]) -> Cameras:
    """Return cameras with other poses and the mean intrinsics."""
    return replace(
        cameras,
        intrinsics=cameras.intrinsics.mean(0).repeat(len(poses), 1, 1),
        cam_to_world=torch.from_numpy(poses).to(cameras.cam_to_world),
    )


def spread(poses: Float[ndarray, "V 4 4"]) -> float:
    """Return the RMS distance of the centers from their mean, 0 if it is rounding."""
    centers = poses[:, :3, 3]
    size = float(np.sqrt(np.square(centers - centers.mean(0)).sum(1).mean()))
    return size if size > ROUNDING * np.abs(centers).max() else 0.0


def pose_vectors(poses: Float[ndarray, "V 4 4"]) -> Float[ndarray, "V 12"]:
    """Return vectors with the distances of poses: in spreads, and in radians for small turns."""
    size = spread(poses)
    centers = poses[:, :3, 3] / size if size else np.zeros((len(poses), 3))
    return np.concatenate((centers, poses[:, :3, :3].reshape(-1, 9) / np.sqrt(2)), 1)


def lengths(vectors: Float[ndarray, "T D"]) -> Float[ndarray, " T"]:
    """Return the Euclidean length of each row."""
    return np.linalg.norm(vectors, axis=1)
