"""The same bits in every run and on any number of threads, and every element is written."""

import pytest
import torch
from scans import Result, both_ways, make_arguments


def assert_same_bits(one: Result, other: Result) -> None:
    for name, value in one.named().items():
        assert torch.equal(value, other.named()[name]), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_any_number_of_threads_gives_the_same_bits(path, threads, dtype, reverse):
    arguments = make_arguments(path[0], 131, channels=4, head_dim=16, state=16, dtype=dtype)

    def run(count):
        threads(count)
        return both_ways(path, arguments, reverse=reverse)

    one = run(1)
    for again in (run(1), run(2)):
        assert_same_bits(again, one)


@pytest.mark.parametrize("length", [1, 67])
def test_every_element_is_written(path, length, reverse):
    arguments = make_arguments(path[0], length)
    clean = both_ways(path, arguments, reverse=reverse)
    torch.use_deterministic_algorithms(True)  # fills torch.empty with NaN
    try:
        assert_same_bits(both_ways(path, arguments, reverse=reverse), clean)
    finally:
        torch.use_deterministic_algorithms(False)
