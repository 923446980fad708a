"""The usual mistakes in poses and intrinsics, each with what undoes it and how to fix it."""

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
CONVENTIONS = {
    ("right", "up", "backward"): "OpenGL",
    ("down", "right", "backward"): "LLFF",
    ("left", "up", "forward"): "PyTorch3D",
    ("forward", "left", "up"): "ROS",
    ("right", "up", "forward"): "Unity",
}
RESOLUTIONS = (0.5, 2.0, 0.25, 4.0, 0.125, 8.0)
OFFSETS = (1, -1, 2, -2, 3, -3)  # frames

# From the rotations and positions of all cameras as read to what they should be.
PoseChange = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
# The same for (fx, fy) and (cx, cy).
LensChange = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Mistake:
    """One way in which cameras may be wrong.

    Args:
        name: what was done, as a sentence without its end.
        fix: what to do about it.
        undo: turns the cameras as read into what they should be.
    """

    name: str
    fix: str
    undo: Callable[[Cameras], Cameras]


def usual_mistakes(names: Sequence[str]) -> list[Mistake]:
    """List the usual mistakes, the likelier first.

    Those with a number to be fitted are not among them: `other_resolution` and `other_focal` make
    them.

    Args:
        names: image files, in the order of the frames.
    """
    resolutions = [other_resolution(factor) for factor in RESOLUTIONS]
    axes = _swapped_axes()
    inverses = [_inverse(), *(_inverse(mistake) for mistake in axes)]
    return [*resolutions, *_swapped_intrinsics(), *axes, *inverses, *_halves(), *_orders(names)]


def other_resolution(factor: float) -> Mistake:
    """Suppose that the intrinsics belong to images `factor` times as large."""
    times = f"{factor:.4g} times" if factor >= 1 else f"1/{1 / factor:.4g}"
    return Mistake(
        f"the intrinsics are those of images {times} the size",
        f"divide fx, fy, cx and cy by {factor:.4g}, or give the images they were made for",
        partial(_with_lens, change=lambda focal, middle: (focal / factor, middle / factor)),
    )


def other_focal(factor: float) -> Mistake:
    """Suppose that the focal lengths alone are `factor` times what they should be."""
    return Mistake(
        f"the focal lengths are {factor:.4g} times what the images show",
        f"divide fx and fy by {factor:.4g}",
        partial(_with_lens, change=lambda focal, middle: (focal / factor, middle)),
    )


def _swapped_intrinsics() -> list[Mistake]:
    changes = {
        "cx and cy": lambda focal, middle: (focal, middle.flip(-1)),
        "fx and fy": lambda focal, middle: (focal.flip(-1), middle),
        "fx and fy, cx and cy": lambda focal, middle: (focal.flip(-1), middle.flip(-1)),
    }
    fix = "exchange them, and look whether the photographs were turned to stand upright"
    return [
        Mistake(f"{name} are exchanged", fix, partial(_with_lens, change=change))
        for name, change in changes.items()
    ]


def _swapped_axes() -> list[Mistake]:
    """List all other orders and signs of the three axes.

    Those that mirror the axes mirror the world too: else the matrix would be no rotation, and the
    reader would have refused it.
    """
    mistakes = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        named = zip(order, signs, strict=True)
        columns = tuple((EXPECTED if sign > 0 else OPPOSITES)[axis] for axis, sign in named)
        # All three signs changed is the same mistake as negated positions.
        if columns not in (EXPECTED, OPPOSITES):
            mistakes.append(_axes(order, signs, columns))
    return mistakes


def _axes(order: tuple[int, ...], signs: tuple[int, ...], columns: tuple[str, ...]) -> Mistake:
    # Column j as read should be column order[j], with the sign signs[j].
    turn = torch.zeros(3, 3, dtype=torch.float64)
    turn[range(3), order] = torch.tensor(signs, dtype=turn.dtype)
    mirror = torch.linalg.det(turn).round()
    elsewhere = [axis for place, axis in enumerate(order) if place != axis]
    if columns in CONVENTIONS:
        name = f"{CONVENTIONS[columns]} axes were taken for OpenCV's, or the reverse"
    elif elsewhere:
        name = (
            f"the cameras' axes {' and '.join('xyz'[i] for i in sorted(elsewhere))} are exchanged"
        )
    else:
        turned = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
        name = f"the cameras' {' and '.join(turned)} point the wrong way"
    fix = (
        f"the columns of cam_to_world as read point {', '.join(columns)}; make them "
        f"{', '.join(EXPECTED)}"
    )
    if mirror < 0:
        fix += ", and mirror the positions as well, since the world is left-handed"
    return Mistake(
        name, fix, partial(_with_poses, change=lambda r, c: (mirror * r @ turn, mirror * c))
    )


def _inverse(axes: Mistake | None = None) -> Mistake:
    name = "world-to-camera matrices were taken for camera-to-world"
    invert = partial(_with_poses, change=lambda r, c: (r.mT, -(r.mT @ c[..., None])[..., 0]))
    if axes is None:
        return Mistake(name, "invert them", invert)
    return Mistake(
        f"{name}, and {axes.name}",
        f"invert them; then {axes.fix}",
        lambda cameras: axes.undo(invert(cameras)),
    )


def _halves() -> list[Mistake]:
    """List mistakes in the rotations alone or in the positions alone."""
    return [
        Mistake(
            "the rotations are transposed, the positions are not",
            "transpose the 3x3 rotations alone",
            partial(_with_poses, change=lambda r, c: (r.mT, c)),
        ),
        Mistake(
            "the translations of world-to-camera were taken for positions",
            "with R of camera-to-world, positions are -R t",
            partial(_with_poses, change=lambda r, c: (r, -(r @ c[..., None])[..., 0])),
        ),
        Mistake(
            "the positions are negated",
            "negate them",
            partial(_with_poses, change=lambda r, c: (r, -c)),
        ),
    ]


def _orders(names: Sequence[str]) -> list[Mistake]:
    """List the ways in which poses belong to other images of the sequence."""
    frames = range(len(names))
    paths = [Path(name) for name in names]
    orders = {
        "the images were sorted by their numbers, the poses as strings (10 before 2)": sorted(
            frames, key=lambda frame: paths[frame].as_posix()
        ),
        "the images were sorted as strings (10 before 2), the poses by their numbers": sorted(
            frames, key=lambda frame: natural_order(paths[frame])
        ),
        "the poses run backwards": list(reversed(frames)),
    }
    for offset in OFFSETS:
        place = "later" if offset > 0 else "earlier"
        frames_away = f"{abs(offset)} frame{'s' if abs(offset) > 1 else ''}"
        name = f"every pose belongs to the image {frames_away} {place}"
        orders[name] = [(frame + offset) % len(frames) for frame in frames]
    # The k-th pose as read belongs to frame order[k].
    return [
        Mistake(
            name,
            "give every image its own pose",
            lambda cameras, order=order: cameras.select(torch.tensor(order).argsort()),
        )
        for name, order in orders.items()
        if order != list(frames)
    ]


def _with_lens(cameras: Cameras, change: LensChange) -> Cameras:
    intrinsics = cameras.intrinsics.clone()
    diagonal = (slice(None), (0, 1), (0, 1))
    focal, middle = change(intrinsics[diagonal], intrinsics[:, :2, 2].clone())
    intrinsics[diagonal], intrinsics[:, :2, 2] = focal, middle
    return replace(cameras, intrinsics=intrinsics)


def _with_poses(cameras: Cameras, change: PoseChange) -> Cameras:
    poses = cameras.cam_to_world.clone()
    poses[:, :3, :3], poses[:, :3, 3] = change(
        cameras.cam_to_world[:, :3, :3], cameras.cam_to_world[:, :3, 3]
    )
    return replace(cameras, cam_to_world=poses)
