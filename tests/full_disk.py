"""A full disk, without one."""

import resource
from contextlib import contextmanager


@contextmanager
def largest_file(size: int):
    """No file grows beyond `size` bytes: writing more is an OSError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
