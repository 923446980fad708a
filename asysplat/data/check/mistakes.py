"""Common mistakes in poses and intrinsics: a correction of the cameras, and advice for each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product
from pathlib import Path

import torch
from torch import Tensor

from asysplat.data.readers.common import natural_order
from asysplat.scene import Cameras

EXPECTED = ("right", "down", "forward")
OPPOSITES = ("left", "up", "backward")
# Directions of the columns of a camera-to-world rotation in other conventions.
CONVENTIONS: dict[tuple[str, ...], str] = {
    ("right", "up", "backward"): "OpenGL",
    ("down", "right", "backward"): "LLFF",
    ("left", "up", "forward"): "PyTorch3D",
    ("forward", "left", "up"): "ROS",
    ("right", "up", "forward"): "Unity",
}
RESOLUTIONS = (0.5, 2.0, 0.25, 4.0, 0.125, 8.0)
OFFSETS = (1, -1, 2, -2, 3, -3)  # images

# Corrects the rotations and positions of all cameras, or their (fx, fy) and (cx, cy).
Change = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Mistake:
    """One way in which cameras may be wrong."""

    name: str
    fix: str
    correct: Callable[[Cameras], Cameras]  # from the cameras as read


def common_mistakes(names: Sequence[str]) -> list[Mistake]:
    """List the mistakes without a factor to fit, the likeliest first; `names` are the images'."""
    resolutions = [other_resolution(factor) for factor in RESOLUTIONS]
    exchange = "exchange them, and check whether the photographs were turned to stand upright"
    exchanged = {
        "cx and cy": lambda focal, center: (focal, center.flip(-1)),
        "fx and fy": lambda focal, center: (focal.flip(-1), center),
        "fx and fy, cx and cy": lambda focal, center: (focal.flip(-1), center.flip(-1)),
    }
    lenses = [_lens_mistake(f"{n} are exchanged", exchange, exchanged[n]) for n in exchanged]
    axes = _swapped_axes()
    inverse = _pose_mistake(
        "world-to-camera matrices were taken for camera-to-world",
        "invert them",
        lambda r, c: (r.mT, -(r.mT @ c[..., None])[..., 0]),
    )
    both = [
        Mistake(
            f"{inverse.name}, and {swap.name}",
            f"{inverse.fix}; then {swap.fix}",
            lambda cameras, correct=swap.correct: correct(inverse.correct(cameras)),
        )
        for swap in axes
    ]
    rotations_or_positions = [
        _pose_mistake(
            "the rotations are transposed, the positions are not",
            "transpose the 3x3 rotations alone",
            lambda r, c: (r.mT, c),
        ),
        _pose_mistake(
            "the translations of world-to-camera were taken for positions",
            "with R of camera-to-world, positions are -R t",
            lambda r, c: (r, -(r @ c[..., None])[..., 0]),
        ),
        _pose_mistake("the positions are negated", "negate them", lambda r, c: (r, -c)),
    ]
    poses = [*axes, inverse, *both, *rotations_or_positions]
    return [*resolutions, *lenses, *poses, *_orders(names)]


def other_resolution(factor: float) -> Mistake:
    """Return the mistake that the intrinsics belong to images `factor` times as large."""
    times = f"{factor:.4g} times" if factor >= 1 else f"1/{1 / factor:.4g}"
    return _lens_mistake(
        f"the intrinsics are those of images {times} the size",
        f"divide fx, fy, cx and cy by {factor:.4g}, or give the images they were made for",
        lambda focal, center: (focal / factor, center / factor),
    )


def other_focal(factor: float) -> Mistake:
    """Return the mistake that the focal lengths are `factor` times too large."""
    return _lens_mistake(
        f"the focal lengths are {factor:.4g} times what the images show",
        f"divide fx and fy by {factor:.4g}",
        lambda focal, center: (focal / factor, center),
    )


def _swapped_axes() -> list[Mistake]:
    """List all other orders and signs of the three axes.

    What mirrors the axes mirrors the world: the reader would have refused what is no rotation.
    """
    mistakes = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        axes = zip(order, signs, strict=True)
        columns = tuple((EXPECTED if sign > 0 else OPPOSITES)[axis] for axis, sign in axes)
        # Changing all three signs is the same mistake as negating the positions.
        if columns in (EXPECTED, OPPOSITES):
            continue
        # Column j as read is the correct column order[j], times signs[j].
        turn = torch.zeros(3, 3, dtype=torch.float64)
        turn[range(3), order] = torch.tensor(signs, dtype=turn.dtype)
        mirror = torch.linalg.det(turn).round()
        exchanged = [axis for column, axis in enumerate(order) if column != axis]
        if columns in CONVENTIONS:
            name = f"{CONVENTIONS[columns]} axes were taken for OpenCV's, or the reverse"
        elif exchanged:
            letters = " and ".join("xyz"[axis] for axis in sorted(exchanged))
            name = f"the cameras' axes {letters} are exchanged"
        else:
            negative = (axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0)
            name = f"the cameras' {' and '.join(negative)} point the wrong way"
        columns_read, columns_right = ", ".join(columns), ", ".join(EXPECTED)
        fix = f"the columns of cam_to_world as read point {columns_read}; make them {columns_right}"
        if mirror < 0:
            fix += ", and mirror the positions as well, since the world is left-handed"
        mistakes.append(_pose_mistake(name, fix, partial(_turned, turn, mirror)))
    return mistakes


def _turned(turn: Tensor, mirror: Tensor, r: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    return mirror * r @ turn, mirror * c


def _orders(names: Sequence[str]) -> list[Mistake]:
    """List the orders in which poses may belong to other images of the sequence."""
    indices = range(len(names))
    as_string = sorted(indices, key=lambda index: Path(names[index]).as_posix())
    by_number = sorted(indices, key=lambda index: natural_order(Path(names[index])))
    sort = "the images were sorted {}, the poses {}".format
    strings, numbers = "as strings", "by their numbers"
    orders = {
        sort(numbers, f"{strings} (10 before 2)"): as_string,
        sort(f"{strings} (10 before 2)", numbers): by_number,
        "the poses run backwards": list(reversed(indices)),
    }
    for offset in OFFSETS:
        distance = f"{abs(offset)} place{'s' if abs(offset) > 1 else ''}"
        name = f"every pose belongs to the image {distance} {'later' if offset > 0 else 'earlier'}"
        orders[name] = [(index + offset) % len(indices) for index in indices]

    # Pose k as read belongs to image order[k].
    places = {name: torch.tensor(order).argsort() for name, order in orders.items()}
    return [
        Mistake(name, "give every image its own pose", lambda c, p=place: c.select(p))
        for name, place in places.items()
        if place.tolist() != list(indices)
    ]


def _lens_mistake(name: str, fix: str, change: Change) -> Mistake:
    def correct(cameras: Cameras) -> Cameras:
        intrinsics = cameras.intrinsics.clone()
        diagonal = (slice(None), (0, 1), (0, 1))
        focal, center = change(intrinsics[diagonal], intrinsics[:, :2, 2].clone())
        intrinsics[diagonal], intrinsics[:, :2, 2] = focal, center
        return replace(cameras, intrinsics=intrinsics)

    return Mistake(name, fix, correct)


def _pose_mistake(name: str, fix: str, change: Change) -> Mistake:
    def correct(cameras: Cameras) -> Cameras:
        poses = cameras.cam_to_world.clone()
        rotations, positions = change(poses[:, :3, :3], poses[:, :3, 3])
        poses[:, :3, :3], poses[:, :3, 3] = rotations.clone(), positions.clone()
        return replace(cameras, cam_to_world=poses)

    return Mistake(name, fix, correct)
