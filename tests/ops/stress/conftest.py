"""Every stress case runs on every path: a scan and one of its backends."""

import pytest
import torch
from scans import PATHS


@pytest.fixture(params=PATHS, ids="-".join, scope="session")
def path(request) -> tuple[str, str]:
    return request.param


@pytest.fixture(params=[False, True], ids=["forwards", "backwards"], scope="session")
def reverse(request) -> bool:
    return request.param


@pytest.fixture
def threads():
    """Set the number of threads until the test's end."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)
