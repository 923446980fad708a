"""Selections: which frames of a scene the network is given, and which it must predict."""

from asysplat.data.selection.frames import (
    Selection,
    Split,
    every_8th_selection,
    first_96_selection,
    held_out,
    spread,
    training_frames,
    training_selection,
    uniform_selection,
)
from asysplat.data.selection.kmeans import kmeans_selection
from asysplat.errors import InputError
from asysplat.scene import Cameras

__all__ = [
    "SELECTIONS",
    "Selection",
    "Split",
    "every_8th_selection",
    "first_96_selection",
    "held_out",
    "kmeans_selection",
    "named_selection",
    "spread",
    "training_frames",
    "training_selection",
    "uniform_selection",
]

SELECTIONS = ("every_8th", "kmeans", "first_96", "uniform")


def named_selection(
    selection: str, cameras: Cameras, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select frames of a scene with these cameras in one of the ways named in SELECTIONS.

    Raises:
        InputError: an unknown name, or too few frames.
    """
    frames = cameras.num_views
    if selection == "every_8th":
        return every_8th_selection(frames, num_inputs, num_targets, split)
    if selection == "kmeans":
        return kmeans_selection(cameras, num_inputs, num_targets, split)
    if selection == "first_96":
        return first_96_selection(frames, num_inputs, num_targets, split)
    if selection == "uniform":
        return uniform_selection(frames, num_inputs, num_targets)
    raise InputError(
        f"data.selection is {selection!r}: expected one of {', '.join(SELECTIONS)}, index."
    )
