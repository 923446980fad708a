"""A global batch divides evenly among processes, or is refused."""

import subprocess
import sys

import pytest

from asysplat.data.loader import split_batch
from asysplat.errors import InputError


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((256, 8, 8), "global batch 256 = 8 processes x 8 scenes x 4 accumulated"),
        ((2, None, 1), "global batch 2 = 1 process x 2 scenes x 1 accumulated"),
        ((7, 3, 1), "global batch 7 = 1 process x 1 scene x 7 accumulated"),
    ],
)
def test_a_batch_is_divided_among_processes(given, expected):
    assert str(split_batch(*given)) == expected


def test_processes_that_do_not_divide_a_batch_are_refused():
    with pytest.raises(InputError, match=r"batch_size=24 .* among 5 processes .*: use 4 processes"):
        split_batch(24, 8, 5)
    with pytest.raises(InputError, match=r"data\.batch_size=3 scenes do not divide among 2 proc"):
        split_batch(3, None, 2)
    with pytest.raises(InputError, match=r"or set data\.batch_size=8\."):
        split_batch(4, None, 8)


LEFT = """
from torch.utils.data import DataLoader
from asysplat.data.loader import ignore_first_sigterm
iterator = iter(DataLoader(range(9), num_workers=1, worker_init_fn=ignore_first_sigterm))
next(iterator)
"""


@pytest.mark.medium
def test_a_program_ends_with_its_loaders():
    subprocess.run([sys.executable, "-c", LEFT], check=True, timeout=60)
