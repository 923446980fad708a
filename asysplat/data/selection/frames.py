"""Selections that need only the number of frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from asysplat.errors import InputError

HELD_OUT_STEP = 8
HELD_OUT_START = {"test": 0, "val": 4}
ABLATION_FRAMES = 96

Split = Literal["val", "test"]


@dataclass(frozen=True)
class Selection:
    """Frame numbers of inputs and targets; unless stated, no frame is both."""

    inputs: list[int]
    targets: list[int]


def uniform_selection(num_frames: int, num_inputs: int, num_targets: int) -> Selection:
    """Select inputs evenly over the whole sequence, targets midway between neighboring inputs.

    Deterministic. If there are fewer gaps than targets, the targets are spread over all frames that
    are not inputs.

    Raises:
        InputError: the sequence is too short.
    """
    _check_length(num_frames, num_inputs, num_targets)
    inputs = spread(range(num_frames), num_inputs)
    gaps = pairwise(inputs)
    candidates = [(before + after) // 2 for before, after in gaps if after - before > 1]
    if len(candidates) < num_targets:
        candidates = sorted(set(range(num_frames)) - set(inputs))
    # The middles of equal parts, so that neither end of the sequence is favored.
    chosen = [(2 * i + 1) * len(candidates) // (2 * num_targets) for i in range(num_targets)]
    return Selection(inputs, [candidates[index] for index in chosen])


def training_selection(
    num_frames: int,
    num_inputs: int,
    num_targets: int,
    window: tuple[int, int],
    rng: np.random.Generator,
    targets_may_be_inputs: bool = False,
) -> Selection:
    """Select inputs evenly over a random window, random targets within it.

    Args:
        window: the least and the greatest number of frames to draw from, both included; clipped
            to the sequence.
        targets_may_be_inputs: whether targets are drawn from all frames of the window.

    Raises:
        InputError: the sequence or the window is too short.
    """
    _check_length(num_frames, num_inputs, num_targets)
    shortest, longest = window
    if not num_inputs + num_targets <= shortest <= longest:
        raise InputError(
            f"data.window is {shortest} to {longest} frames: give two increasing numbers, the "
            f"first at least data.inputs + data.targets = {num_inputs + num_targets}."
        )
    length = int(rng.integers(min(shortest, num_frames), min(longest, num_frames) + 1))
    start = int(rng.integers(num_frames - length + 1))
    frames = range(start, start + length)
    inputs = spread(frames, num_inputs)
    candidates = frames if targets_may_be_inputs else sorted(set(frames) - set(inputs))
    return Selection(inputs, sorted(rng.choice(candidates, num_targets, replace=False).tolist()))


def held_out(num_frames: int, split: Split) -> list[int]:
    """Return frames 0, 8, 16, ... for test (paper, Suppl. A), 4, 12, 20, ... for val."""
    return list(range(HELD_OUT_START[split], num_frames, HELD_OUT_STEP))


def training_frames(num_frames: int) -> list[int]:
    """Return the frames that neither validation nor test holds out."""
    out = held_out(num_frames, "val") + held_out(num_frames, "test")
    return sorted(set(range(num_frames)) - set(out))


def every_8th_selection(
    num_frames: int, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select inputs evenly over the trained frames, targets evenly over those held out.

    Deterministic; there are at most `num_targets` targets.

    Raises:
        InputError: the sequence is too short.
    """
    inputs, targets = training_frames(num_frames), held_out(num_frames, split)
    check_held_out(num_frames, len(inputs), num_inputs, split)
    return Selection(spread(inputs, num_inputs), spread(targets, min(num_targets, len(targets))))


def first_96_selection(
    num_frames: int, num_inputs: int, num_targets: int, split: Split
) -> Selection:
    """Select as the paper's ablations do (Suppl. A).

    Of the first 96 frames every 8th is a target, and inputs lie evenly over the others.
    Deterministic.

    Raises:
        InputError: the sequence is too short.
    """
    inputs, targets = paper_frames(min(num_frames, ABLATION_FRAMES), num_targets, split)
    check_held_out(num_frames, len(inputs), num_inputs, split)
    return Selection(spread(inputs, num_inputs), targets)


def paper_frames(num_frames: int, num_targets: int, split: Split) -> tuple[list[int], list[int]]:
    """Return the frames that inputs are chosen from, and the targets.

    For test, every 8th frame is a target, and inputs are chosen from all others. For val, no frame
    of the test is used: there are at most `num_targets` targets, and inputs are chosen from the
    trained frames.
    """
    targets = held_out(num_frames, split)
    if split == "val":
        return training_frames(num_frames), spread(targets, min(num_targets, len(targets)))
    return sorted(set(range(num_frames)) - set(targets)), targets


def spread(frames: Sequence[int], count: int) -> list[int]:
    """Choose `count` different frames at even distances, the first and the last among them."""
    positions = np.linspace(0, len(frames) - 1, count)
    return [frames[int(position + 0.5)] for position in positions]


def check_held_out(num_frames: int, left: int, num_inputs: int, split: Split) -> None:
    """Check that there are targets, and enough frames `left` to choose the inputs from.

    Raises:
        InputError: there are not.
    """
    if left < num_inputs or not held_out(num_frames, split):
        raise InputError(
            f"The sequence has {num_frames} frames, of which {left} are not held out for "
            f"{split}: set data.inputs to at most that, or give a longer sequence."
        )


def _check_length(num_frames: int, num_inputs: int, num_targets: int) -> None:
    if num_inputs < 1 or num_targets < 0:
        raise InputError(
            f"data.inputs is {num_inputs} and data.targets {num_targets}: "
            "give at least one input and no negative number."
        )
    if num_frames < num_inputs + num_targets:
        raise InputError(
            f"The sequence has {num_frames} frames, fewer than {num_inputs} inputs and "
            f"{num_targets} targets: set data.inputs and data.targets to at most {num_frames} "
            "together."
        )
