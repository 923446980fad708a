"""Every case of the scans runs on every path: a scan and one of its backends."""

import pytest
from scans import PATHS


@pytest.fixture(params=PATHS, ids="-".join, scope="session")
def path(request) -> tuple[str, str]:
    return request.param


@pytest.fixture(params=[False, True], ids=["forwards", "backwards"], scope="session")
def reverse(request) -> bool:
    return request.param
