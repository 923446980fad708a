"""Inputs that cover a scene best, by k-means: the paper's evaluation (Suppl. A)."""

import warnings

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from threadpoolctl import threadpool_limits

from asysplat.data.selection.splits import Split, Stage, check_held_out, paper_frames
from asysplat.scene import Cameras

DECIMALS = 4  # of features of length 1: far above rounding, far below what tells frames apart


def kmeans_split(cameras: Cameras, num_inputs: int, num_targets: int, stage: Stage) -> Split:
    """Every 8th frame is a target; of the others, those nearest to the centres of k-means on
    positions and viewing directions are the inputs. Deterministic, on every machine.

    Raises:
        InputError: the sequence is too short.
    """
    frames, targets = paper_frames(cameras.num_views, num_targets, stage)
    check_held_out(cameras.num_views, len(frames), num_inputs, stage)
    chosen = nearest_to_centres(pose_features(cameras.select(frames)), num_inputs)
    return Split([frames[index] for index in chosen], targets)


def pose_features(cameras: Cameras) -> Float[ndarray, "V 6"]:
    """Positions about their mean in units of their root mean square, then viewing directions: both
    of length 1, so that they weigh alike. Rounded, so that float noise makes no difference."""
    poses = cameras.cam_to_world.double().cpu().numpy()
    offsets = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    length = np.sqrt((offsets**2).sum(-1).mean())
    # Cameras in one place differ in nothing but rounding.
    if length > 1e-6 * np.abs(poses[:, :3, 3]).max():
        offsets = offsets / length
    features = np.concatenate([offsets, poses[:, :3, 2]], axis=1)
    return features.round(DECIMALS) + 0.0  # without -0


def nearest_to_centres(features: Float[ndarray, "V d"], count: int) -> list[int]:
    """`count` different rows, each the nearest to a centre of k-means; in order.

    The nearest pair of centre and row is taken first, and neither again; of rows as near, the
    first.
    """
    from sklearn.cluster import KMeans  # slow to import

    model = KMeans(count, init="k-means++", n_init=1, random_state=0)
    # With one thread, sums have one order.
    with threadpool_limits(1), warnings.catch_warnings():
        # Fewer different rows than centres: some centres coincide, and take the rows next to them.
        warnings.filterwarnings("ignore", message="Number of distinct clusters")
        centres = model.fit(features).cluster_centers_
    distances = np.linalg.norm(features[:, None] - centres, axis=-1).round(DECIMALS)
    rows, free = [], set(range(count))
    # Row-major, and stable: of equal distances the first row comes first.
    for place in np.argsort(distances, axis=None, kind="stable"):
        row, centre = divmod(int(place), count)
        if centre in free and row not in rows:
            free.remove(centre)
            rows.append(row)
    return sorted(rows)
