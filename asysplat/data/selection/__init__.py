"""Which frames of a scene the network is given, and which it must predict: pure, and seeded."""

from asysplat.data.selection.kmeans import kmeans_split
from asysplat.data.selection.splits import (
    Split,
    Stage,
    evaluation_split,
    first_96_split,
    held_out,
    held_out_split,
    spread,
    trained,
    training_split,
)
from asysplat.errors import InputError
from asysplat.scene import Cameras

__all__ = [
    "SELECTIONS",
    "Split",
    "Stage",
    "evaluation_split",
    "first_96_split",
    "held_out",
    "held_out_split",
    "kmeans_split",
    "selected_split",
    "spread",
    "trained",
    "training_split",
]

SELECTIONS = ("every_8th", "kmeans", "first_96", "uniform")


def selected_split(
    selection: str, cameras: Cameras, num_inputs: int, num_targets: int, stage: Stage
) -> Split:
    """The split of one of SELECTIONS, for a scene with these cameras.

    Raises:
        InputError: an unknown name, or too few frames.
    """
    frames = cameras.num_views
    if selection == "every_8th":
        return held_out_split(frames, num_inputs, num_targets, stage)
    if selection == "kmeans":
        return kmeans_split(cameras, num_inputs, num_targets, stage)
    if selection == "first_96":
        return first_96_split(frames, num_inputs, num_targets, stage)
    if selection == "uniform":
        return evaluation_split(frames, num_inputs, num_targets)
    raise InputError(
        f"data.selection is {selection!r}: expected one of {', '.join(SELECTIONS)}, index."
    )
