"""Selections: which images of a scene are given to the network, and which it must predict.

All functions are deterministic but for `training_selection`, and raise an InputError if a sequence
is too short for the number of inputs and targets.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from threadpoolctl import threadpool_limits

from asysplat.errors import InputError
from asysplat.scene import Cameras

SELECTIONS = ("every_8th", "kmeans", "first_96", "uniform")
HELD_OUT_STEP = 8
HELD_OUT_START = {"test": 0, "val": 4}
ABLATION_IMAGES = 96
DECIMALS = 5  # decimals kept of positions and directions; cameras differ by more
FLOAT_NOISE = 1e-6  # relative difference up to which distances count as equal

Split = Literal["val", "test"]


@dataclass(frozen=True)
class Selection:
    """Indices of inputs and targets; unless stated, no image is both."""

    inputs: list[int]
    targets: list[int]


def named_selection(
    selection: str,
    cameras: Cameras,
    num_inputs: int,
    num_targets: int,
    split: Split,
    published: Sequence[int] = (),
) -> Selection:
    """Select images of a scene with these cameras by one of the methods in SELECTIONS.

    The images that its data set holds out, `published`, count in every_8th, see `held_out`.
    """
    if selection not in SELECTIONS:
        raise InputError(
            f"data.selection is {selection!r}: expected one of {', '.join(SELECTIONS)}, index."
        )
    if selection == "kmeans":
        return kmeans_selection(cameras, num_inputs, num_targets, split)
    if selection == "uniform":
        return uniform_selection(cameras.num_views, num_inputs, num_targets)
    if selection == "first_96":
        return first_96_selection(cameras.num_views, num_inputs, num_targets, split)
    return every_8th_selection(cameras.num_views, num_inputs, num_targets, split, published)


def uniform_selection(num_images: int, num_inputs: int, num_targets: int) -> Selection:
    """Select inputs evenly over the whole sequence, targets midway between neighboring inputs.

    If there are fewer gaps than targets, the targets are spread over all images but the inputs.
    """
    _check_length(num_images, num_inputs, num_targets)
    inputs = evenly_spaced(range(num_images), num_inputs)
    gaps = pairwise(inputs)
    candidates = [(before + after) // 2 for before, after in gaps if after - before > 1]
    if len(candidates) < num_targets:
        candidates = sorted(set(range(num_images)) - set(inputs))
    # The middles of equal parts, so that neither end of the sequence is favored.
    chosen = [(2 * i + 1) * len(candidates) // (2 * num_targets) for i in range(num_targets)]
    return Selection(inputs, [candidates[index] for index in chosen])


def training_selection(
    num_images: int,
    num_inputs: int,
    num_targets: int,
    window: tuple[int, int] | None,
    rng: np.random.Generator,
    targets_may_be_inputs: bool = False,
) -> Selection:
    """Select inputs evenly over a random window, of least and greatest length, and targets."""
    _check_length(num_images, num_inputs, num_targets)
    shortest, longest = (num_images, num_images) if window is None else window
    if not num_inputs + num_targets <= shortest <= longest:
        raise InputError(
            f"data.window is {shortest} to {longest} images: give two increasing numbers, the "
            f"first at least data.inputs + data.targets = {num_inputs + num_targets}."
        )
    length = int(rng.integers(min(shortest, num_images), min(longest, num_images) + 1))
    start = int(rng.integers(num_images - length + 1))
    images = range(start, start + length)
    inputs = evenly_spaced(images, num_inputs)
    candidates = images if targets_may_be_inputs else sorted(set(images) - set(inputs))
    return Selection(inputs, sorted(rng.choice(candidates, num_targets, replace=False).tolist()))


def grown_window(
    first: Sequence[int] | None, last: Sequence[int] | None, grown: float
) -> tuple[int, int] | None:
    """Return the window at a fraction of its growth from `first` to `last`; without one, `last`."""
    if last is None:
        return None
    shortest, longest = last
    if first is not None:
        shortest, longest = (round(a + grown * (b - a)) for a, b in zip(first, last, strict=True))
    return shortest, longest


def held_out(num_images: int, split: Split, published: Sequence[int] = ()) -> list[int]:
    """Return images 0, 8, 16, ... for test (paper, Suppl. A), 4, 12, 20, ... for val.

    Where a data set holds out images, test has those, and val 4, 12, 20, ... of the others.
    """
    if published and split == "test":
        return list(published)
    others = sorted(set(range(num_images)) - set(published))
    return others[HELD_OUT_START[split] :: HELD_OUT_STEP]


def training_images(num_images: int, published: Sequence[int] = ()) -> list[int]:
    """Return the images that neither validation nor test holds out."""
    out = held_out(num_images, "val", published) + held_out(num_images, "test", published)
    return sorted(set(range(num_images)) - set(out))


def every_8th_selection(
    num_images: int,
    num_inputs: int,
    num_targets: int,
    split: Split,
    published: Sequence[int] = (),
) -> Selection:
    """Select inputs evenly over the training images, at most `num_targets` held-out targets."""
    images = training_images(num_images, published)
    targets = held_out(num_images, split, published)
    check_held_out(num_images, images, targets, num_inputs, split)
    return Selection(
        evenly_spaced(images, num_inputs), evenly_spaced(targets, min(num_targets, len(targets)))
    )


def first_96_selection(
    num_images: int, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select as the paper's ablations (Suppl. A): inputs evenly over the first 96 images.

    Positions are truncated to whole ones, as in Long-LRM (data/dataset.py); the paper does not say.
    """
    images, targets = paper_split(min(num_images, ABLATION_IMAGES), num_targets, split)
    check_held_out(num_images, images, targets, num_inputs, split)
    positions = np.linspace(0, len(images) - 1, num_inputs, dtype=int)
    return Selection([images[position] for position in positions], targets)


def paper_split(num_images: int, num_targets: int, split: Split) -> tuple[list[int], list[int]]:
    """Return the images that inputs are chosen from, and the targets.

    For test, these are every 8th image and all others; for val, at most `num_targets` held-out
    images and the training images.
    """
    targets = held_out(num_images, split)
    if split == "val":
        return training_images(num_images), evenly_spaced(targets, min(num_targets, len(targets)))
    return sorted(set(range(num_images)) - set(targets)), targets


def evenly_spaced(images: Sequence[int], count: int) -> list[int]:
    """Choose `count` different images at even distances, the first and the last among them."""
    positions = np.linspace(0, len(images) - 1, count)
    return [images[int(position + 0.5)] for position in positions]


def check_held_out(
    num_images: int, images: list[int], targets: list[int], num_inputs: int, split: Split
) -> None:
    """Check that there are targets, and enough images for the inputs."""
    if len(images) < num_inputs or not targets:
        raise InputError(
            f"The sequence has {num_images} images, of which {len(images)} are not held out for "
            f"{split}: set data.inputs to at most that, or give a longer sequence."
        )


def _check_length(num_images: int, num_inputs: int, num_targets: int) -> None:
    if num_inputs < 1 or num_targets < 0:
        raise InputError(
            f"data.inputs is {num_inputs} and data.targets {num_targets}: "
            "give at least one input and no negative number."
        )
    if num_images < num_inputs + num_targets:
        raise InputError(
            f"The sequence has {num_images} images, fewer than {num_inputs} inputs and "
            f"{num_targets} targets: set data.inputs and data.targets to at most {num_images} "
            "together."
        )


def kmeans_selection(
    cameras: Cameras, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select as the paper's tests do: inputs by k-means on positions and viewing directions."""
    images, targets = paper_split(cameras.num_views, num_targets, split)
    check_held_out(cameras.num_views, images, targets, num_inputs, split)
    chosen = nearest_to_centers(pose_features(cameras.select(images)), num_inputs)
    return Selection([images[index] for index in chosen], targets)


def pose_features(cameras: Cameras) -> Float[ndarray, "V 6"]:
    """Return positions, relative to their mean, and viewing directions, as Long-LRM does.

    Rounded, relative to their extent, so that float noise makes no difference.
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
    """Choose `count` different rows, sorted: each the first of those nearest to a center."""
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
