"""Inputs that cover a scene best, by k-means: the paper's evaluation (Suppl. A)."""

import warnings

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from threadpoolctl import threadpool_limits

from asysplat.data.selection.views import Selection, Split, check_held_out, paper_split
from asysplat.scene import Cameras

DECIMALS = 5  # decimals kept of positions and directions; cameras differ by more
FLOAT_NOISE = 1e-6  # relative difference up to which distances count as equal


def kmeans_selection(
    cameras: Cameras, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select as the paper's tests do: inputs by k-means on positions and viewing directions.

    Every 8th image is a target; of the others, those nearest to the centers are inputs.
    Deterministic, on every machine.
    """
    images, targets = paper_split(cameras.num_views, num_targets, split)
    check_held_out(cameras.num_views, len(images), num_inputs, split)
    chosen = nearest_to_centers(pose_features(cameras.select(images)), num_inputs)
    return Selection([images[index] for index in chosen], targets)


def pose_features(cameras: Cameras) -> Float[ndarray, "V 6"]:
    """Return positions, relative to their mean, and viewing directions of length 1.

    As in Long-LRM (data/dataset.py): positions are in the units of the data. Rounded, relative to
    their extent, so that float noise makes no difference.
    """
    poses = cameras.cam_to_world.double().cpu().numpy()
    offsets = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    extent = np.abs(offsets).max()
    # Positions of cameras in one place differ by rounding alone.
    same = extent <= 1e-6 * np.abs(poses[:, :3, 3]).max()
    unit = 1.0 if same else 10.0 ** np.floor(np.log10(extent))
    offsets = np.zeros_like(offsets) if same else (offsets / unit).round(DECIMALS) * unit
    return np.concatenate([offsets, poses[:, :3, 2].round(DECIMALS)], axis=1) + 0.0  # without -0


def nearest_to_centers(features: Float[ndarray, "V d"], count: int) -> list[int]:
    """Choose `count` different rows, each nearest to a center of k-means; sorted.

    Of rows whose distances differ by float noise, the first is taken.
    """
    from sklearn.cluster import KMeans  # slow to import

    model = KMeans(count, init="k-means++", n_init=1, random_state=0)
    # With one thread, numbers are always summed in the same order.
    with threadpool_limits(1), warnings.catch_warnings():
        # With fewer different rows than centers, some centers coincide and take the next rows.
        warnings.filterwarnings("ignore", message="Number of distinct clusters")
        centers = model.fit(features).cluster_centers_
    distances = np.linalg.norm(features[:, None] - centers, axis=-1)
    noise = FLOAT_NOISE * distances.max()
    rows: list[int] = []
    for distance in distances.T:
        distance[rows] = np.inf
        rows.append(int((distance <= distance.min() + noise).argmax()))
    return sorted(rows)
