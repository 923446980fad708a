"""Every stress case runs on every backend."""

import pytest
from backends import BACKENDS, FAST, Backend


@pytest.fixture(params=BACKENDS, ids=str, scope="session")
def backend(request) -> Backend:
    return request.param


@pytest.fixture(params=FAST, ids=str, scope="session")
def fast_backend(request) -> Backend:
    """A backend that is compared with the reference."""
    return request.param
