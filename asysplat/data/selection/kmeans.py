"""Inputs that cover a scene best, by k-means: the paper's evaluation (Suppl. A)."""

import warnings

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from threadpoolctl import threadpool_limits

from asysplat.data.selection.views import Selection, Split, check_held_out, paper_split
from asysplat.scene import Cameras

DECIMALS = 4  # of features of length 1: above float noise, below the differences between cameras


def kmeans_selection(
    cameras: Cameras, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select as the paper's tests do: inputs by k-means on positions and viewing directions.

    Every 8th image is a target; of the others, those nearest to the centers are inputs.
    Deterministic, on every machine.

    Raises:
        InputError: the sequence is too short.
    """
    images, targets = paper_split(cameras.num_views, num_targets, split)
    check_held_out(cameras.num_views, len(images), num_inputs, split)
    chosen = nearest_to_centers(pose_features(cameras.select(images)), num_inputs)
    return Selection([images[index] for index in chosen], targets)


def pose_features(cameras: Cameras) -> Float[ndarray, "V 6"]:
    """Return positions and viewing directions, scaled to equal weight.

    Positions are relative to their mean, in units of their root mean square; directions have length
    1. Rounded, so that float noise makes no difference.
    """
    poses = cameras.cam_to_world.double().cpu().numpy()
    offsets = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    length = np.sqrt((offsets**2).sum(-1).mean())
    # Positions of cameras in one place differ by rounding alone, and are left unscaled.
    if length > 1e-6 * np.abs(poses[:, :3, 3]).max():
        offsets = offsets / length
    features = np.concatenate([offsets, poses[:, :3, 2]], axis=1)
    return features.round(DECIMALS) + 0.0  # without -0


def nearest_to_centers(features: Float[ndarray, "V d"], count: int) -> list[int]:
    """Choose `count` different rows, each near a center of k-means; sorted.

    Matches centers and rows greedily by distance; of equally near rows, the first is taken.
    """
    from sklearn.cluster import KMeans  # slow to import

    model = KMeans(count, init="k-means++", n_init=1, random_state=0)
    # With one thread, numbers are always summed in the same order.
    with threadpool_limits(1), warnings.catch_warnings():
        # With fewer different rows than centers, some centers coincide and take the next rows.
        warnings.filterwarnings("ignore", message="Number of distinct clusters")
        centers = model.fit(features).cluster_centers_
    distances = np.linalg.norm(features[:, None] - centers, axis=-1).round(DECIMALS)
    rows, free = [], set(range(count))
    # Row-major, and stable: of equal distances the first row comes first.
    for position in np.argsort(distances, axis=None, kind="stable"):
        row, center = divmod(int(position), count)
        if center in free and row not in rows:
            free.remove(center)
            rows.append(row)
    return sorted(rows)
