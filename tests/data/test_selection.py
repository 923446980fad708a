import numpy as np
import pytest

from asysplat.data.selection import evaluation_split, training_split
from asysplat.errors import InputError


def test_evaluation_inputs_are_even_and_targets_midway():
    split = evaluation_split(num_frames=17, num_inputs=5, num_targets=4)
    assert split.inputs == [0, 4, 8, 12, 16]
    assert split.targets == [2, 6, 10, 14]


def test_evaluation_targets_are_spread_over_the_gaps():
    split = evaluation_split(num_frames=81, num_inputs=9, num_targets=2)
    assert split.targets == [25, 65]


def test_evaluation_uses_every_frame_of_the_shortest_sequence():
    split = evaluation_split(num_frames=7, num_inputs=4, num_targets=3)
    assert split.inputs == [0, 2, 4, 6]
    assert split.targets == [1, 3, 5]


@pytest.mark.parametrize("num_frames", range(8, 60))
def test_evaluation_never_shares_or_repeats_a_frame(num_frames):
    split = evaluation_split(num_frames, num_inputs=3, num_targets=5)
    chosen = split.inputs + split.targets
    assert len(set(chosen)) == 8 and min(chosen) >= 0 and max(chosen) < num_frames
    assert split.targets == sorted(split.targets)


def test_training_stays_in_its_window_and_never_shares_a_frame():
    rng = np.random.default_rng(0)
    starts, backwards = set(), 0
    for _ in range(200):
        split = training_split(50, num_inputs=4, num_targets=3, window=(10, 20), rng=rng)
        ordered = sorted(split.inputs)
        assert len(set(split.inputs + split.targets)) == 7
        assert 10 <= ordered[-1] - ordered[0] + 1 <= 20
        assert ordered[0] < min(split.targets) and max(split.targets) < ordered[-1]
        assert np.ptp(np.diff(ordered)) <= 1
        assert (split.inputs == ordered) == (split.targets == sorted(split.targets))
        starts.add(ordered[0])
        backwards += split.inputs != ordered
    assert min(starts) <= 1 and max(starts) >= 36 and len(starts) > 30
    assert 70 < backwards < 130


def test_training_is_repeated_by_its_seed():
    drawn = [training_split(50, 4, 3, (10, 20), np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_window_is_clipped_to_a_short_sequence():
    split = training_split(9, 4, 3, (64, 128), np.random.default_rng(0))
    assert sorted(split.inputs) == [0, 3, 5, 8]


def test_too_short_a_sequence_says_what_to_set():
    with pytest.raises(InputError, match=r"has 6 frames.*data\.inputs and data\.targets.*6"):
        evaluation_split(6, num_inputs=4, num_targets=3)
    with pytest.raises(InputError, match="has 6 frames"):
        training_split(6, 4, 3, (8, 9), np.random.default_rng(0))


@pytest.mark.parametrize("window", [(6, 20), (20, 10)])
def test_unusable_window_is_named(window):
    with pytest.raises(InputError, match=r"data\.window"):
        training_split(50, 4, 3, window, np.random.default_rng(0))


def test_zero_inputs_are_refused():
    with pytest.raises(InputError, match=r"data\.inputs is 0"):
        evaluation_split(9, num_inputs=0, num_targets=3)
