"""What the lists of a backend can hold."""

from asysplat.errors import InputError

MOST_PAIRS = 2**31 - 1  # that int32 can number


def check_pairs(pairs: int) -> None:
    """Raise InputError for more pairs of Gaussian and tile than a list can number."""
    if pairs > MOST_PAIRS:
        raise InputError(
            f"render needs {pairs} pairs of Gaussian and tile, and its lists hold {MOST_PAIRS}: "
            "set views_at_once, or render smaller Gaussians."
        )
