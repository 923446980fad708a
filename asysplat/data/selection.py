"""Which frames of a sequence the network sees, and which it must predict."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from asysplat.errors import InputError

HELD_OUT_STEP = 8
HELD_OUT_START = {"test": 0, "val": 4}


@dataclass(frozen=True)
class Split:
    """Frame numbers; no frame is both an input and a target."""

    inputs: list[int]
    targets: list[int]


def evaluation_split(num_frames: int, num_inputs: int, num_targets: int) -> Split:
    """Inputs evenly over the whole sequence, targets midway between neighbouring inputs.

    Deterministic. Where fewer gaps than targets exist, the targets are spread over all frames that
    are not inputs.

    Raises:
        InputError: the sequence is too short.
    """
    _check_length(num_frames, num_inputs, num_targets)
    inputs = _spread(range(num_frames), num_inputs)
    gaps = pairwise(inputs)
    candidates = [(before + after) // 2 for before, after in gaps if after - before > 1]
    if len(candidates) < num_targets:
        candidates = sorted(set(range(num_frames)) - set(inputs))
    # The middles of equal parts, so that neither end of the sequence is favoured.
    chosen = [(2 * i + 1) * len(candidates) // (2 * num_targets) for i in range(num_targets)]
    return Split(inputs, [candidates[index] for index in chosen])


def training_split(
    num_frames: int,
    num_inputs: int,
    num_targets: int,
    window: tuple[int, int],
    rng: np.random.Generator,
) -> Split:
    """Inputs evenly over a random window, random targets within it, half of the time backwards.

    Args:
        window: the least and the greatest number of frames to draw from, both included; clipped
            to the sequence.

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
    inputs = _spread(frames, num_inputs)
    others = sorted(set(frames) - set(inputs))
    targets = sorted(rng.choice(others, num_targets, replace=False).tolist())
    if rng.random() < 0.5:
        return Split(inputs[::-1], targets[::-1])
    return Split(inputs, targets)


def held_out(num_frames: int, stage: Literal["val", "test"]) -> list[int]:
    """Every 8th frame: from the first on for the test (paper, Suppl. A), from the fifth for
    validation."""
    return list(range(HELD_OUT_START[stage], num_frames, HELD_OUT_STEP))


def trained(num_frames: int) -> list[int]:
    """The frames that no stage holds out."""
    out = held_out(num_frames, "val") + held_out(num_frames, "test")
    return sorted(set(range(num_frames)) - set(out))


def held_out_split(
    num_frames: int, num_inputs: int, num_targets: int, stage: Literal["val", "test"]
) -> Split:
    """Inputs evenly over the trained frames, at most `num_targets` targets evenly over those held
    out. Deterministic.

    Raises:
        InputError: the sequence is too short.
    """
    inputs, targets = trained(num_frames), held_out(num_frames, stage)
    num_targets = min(num_targets, len(targets))
    if len(inputs) < num_inputs or not targets:
        raise InputError(
            f"The sequence has {num_frames} frames, of which {len(inputs)} are not held out for "
            f"{stage}: set data.inputs to at most that, or give a longer sequence."
        )
    return Split(_spread(inputs, num_inputs), _spread(targets, num_targets))


def _spread(frames: Sequence[int], count: int) -> list[int]:
    """`count` different frames at even distances, the first and the last among them."""
    positions = np.linspace(0, len(frames) - 1, count)
    return [frames[int(position + 0.5)] for position in positions]


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
