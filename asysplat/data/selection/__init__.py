"""Selections: which images of a scene are given to the network, and which it must predict."""

from asysplat.data.selection.kmeans import kmeans_selection
from asysplat.data.selection.views import (
    Selection,
    Split,
    every_8th_selection,
    first_96_selection,
    uniform_selection,
)
from asysplat.errors import InputError
from asysplat.scene import Cameras

SELECTIONS = ("every_8th", "kmeans", "first_96", "uniform")


def named_selection(
    selection: str, cameras: Cameras, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select images of a scene with these cameras by one of the methods in SELECTIONS."""
    if selection not in SELECTIONS:
        raise InputError(
            f"data.selection is {selection!r}: expected one of {', '.join(SELECTIONS)}, index."
        )
    if selection == "kmeans":
        return kmeans_selection(cameras, num_inputs, num_targets, split)
    if selection == "uniform":
        return uniform_selection(cameras.num_views, num_inputs, num_targets)
    by_number = every_8th_selection if selection == "every_8th" else first_96_selection
    return by_number(cameras.num_views, num_inputs, num_targets, split)
