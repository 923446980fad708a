"""The photographs of one scene: those that are fitted to, and those held out to measure."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.data import open_scene
from asysplat.data.bad_images import Policy
from asysplat.data.check.matches import find_matches
from asysplat.data.check.report import judge
from asysplat.data.normalize import Normalization, normalize
from asysplat.data.selection import spread
from asysplat.data.sequence import FileSequence
from asysplat.errors import InputError
from asysplat.scene import Views

ANY_SIZE = 8  # pixels a side: to read cameras, before the size is known


@dataclass(frozen=True)
class Photographs:
    """Views of one scene in the network's frame, and the way back.

    Args:
        name: of the scene.
        inputs: views that are fitted to.
        measured: views that are held out; None where there are none.
        input_files, measured_files: the names of their photographs.
        frame: brings Gaussians back to the world of the files.
        points: sparse points in the network's frame; None where the files have none.
    """

    name: str
    inputs: Views
    measured: Views | None
    input_files: list[str]
    measured_files: list[str]
    frame: Normalization
    points: Float[Tensor, "P 3"] | None


def open_photographs(
    path: str | Path,
    height: int,
    width: int | None = None,
    views: int = 32,
    held_out: int | None = 8,
    max_held_out: int = 12,
    layout: str = "auto",
    on_bad_image: Policy = "fail",
    say: Callable[[str], None] = print,
) -> Photographs:
    """Open posed photographs, choose some evenly, and bring them into the network's frame.

    Args:
        path: a scene, in any layout that `open_scene` reads.
        height, width: of the views, in pixels; width None: that of the first photograph at this
            height.
        views: how many are fitted to, at most.
        held_out: one frame in so many, from the first on, is measured and not fitted to; None:
            none is.
        max_held_out: of these.
        layout, on_bad_image: see `open_scene`.
        say: takes a sentence where there are fewer views than asked for, or where the cameras do
            not fit the photographs.

    Raises:
        InputError: fewer than two photographs are left to fit to; see `open_scene`.
    """
    if height < 1 or (width is not None and width < 1) or views < 2 or (held_out or 2) < 2:
        raise InputError(
            f"height={height}, width={width}, views={views} and held_out={held_out}: give at "
            "least 1 pixel, 2 views and one frame in 2, or held_out=null."
        )
    scene = open_scene(path, ANY_SIZE, ANY_SIZE, layout, on_bad_image).scene
    lens = scene.photographs[0].lens
    sequence = FileSequence(
        scene, height, max(1, round(height * lens.width / lens.height)) if width is None else width
    )
    frames = range(sequence.num_frames)
    measured = list(frames[::held_out]) if held_out else []
    left = sorted(set(frames) - set(measured))
    if len(left) < 2:
        raise InputError(
            f"{path} has {len(frames)} photographs, of which held_out={held_out} leaves "
            f"{len(left)}: set held_out=null, or give more photographs."
        )
    if len(left) < views:
        say(f"{path} has {len(left)} photographs to fit to, not {views}: all are used.")
    chosen = spread(left, min(views, len(left)))
    measured = spread(measured, min(max_held_out, len(measured))) if measured else []
    fitted = replace(scene, photographs=[scene.photographs[frame] for frame in chosen])
    _warn_of_cameras(FileSequence(fitted, sequence.cameras.height, sequence.cameras.width), say)
    inputs = sequence.views(chosen).validate(str(path))
    targets = sequence.views(measured).validate(str(path)) if measured else inputs
    inputs, targets, frame = normalize(inputs, targets)
    return Photographs(
        name=scene.name,
        inputs=inputs,
        measured=targets if measured else None,
        input_files=[str(scene.photographs[frame].image) for frame in chosen],
        measured_files=[str(scene.photographs[frame].image) for frame in measured],
        frame=frame,
        points=_moved_points(scene.points, frame),
    )


def _moved_points(points: object, frame: Normalization) -> Float[Tensor, "P 3"] | None:
    if points is None or len(points) == 0:
        return None
    pose = frame.world_to_mean
    moved = torch.as_tensor(points, dtype=torch.float64) @ pose[:3, :3].mT + pose[:3, 3]
    return (moved * frame.scale).float()


def _warn_of_cameras(sequence: FileSequence, say: Callable[[str], None]) -> None:
    """Say so where points that are found in several photographs do not fit the cameras."""
    names = [str(photograph.image) for photograph in sequence.scene.photographs]
    verdict = judge(sequence.cameras, find_matches(sequence), names)
    if not verdict.fits:
        say(
            f"warning: {verdict.sentence}; python -m asysplat.data.check shows it at full size. "
            "The reconstruction goes on."
        )
