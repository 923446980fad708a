import pytest
import torch


@pytest.fixture(scope="module")
def one_thread():
    """Small images gain nothing from threads, and threads slow down tests that run in parallel."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
