"""The hostile Gaussians and cameras of `benchmark.py suite=stability`, on every fast backend."""

import pytest
from backends import INTERPRETED

from benchmarks.stability.hostile import HOSTILE_GAUSSIANS, HostileViews, hostile_views
from benchmarks.stability.renderer import measure

CASES = {f"Gaussians {name}": (HostileViews(), name) for name in HOSTILE_GAUSSIANS}
CASES |= {
    name: (views, None)
    for name, views in hostile_views([1, 8]).items()
    if "photographs" not in name
}


@pytest.mark.medium
@pytest.mark.skipif(INTERPRETED, reason="too many Gaussians for the interpreter")
@pytest.mark.parametrize("name", CASES)
def test_error_is_within_what_rounding_explains(fast_backend, name):
    row = measure(*CASES[name], backend=fast_backend.name)
    assert row["green"], row
