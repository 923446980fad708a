"""What the lists of a backend can hold."""

from asysplat.errors import InputError

MOST_PAIRS = 2**31 - 1  # that int32 can number
MOST_IN_TILE = 2**24  # that float32 can count


def check_pairs(pairs: int, longest: int = 0) -> None:
    """Raise InputError for more pairs of Gaussian and tile than a list can number, or more in the
    longest list of a tile than it can count."""
    if longest > MOST_IN_TILE:
        raise InputError(
            f"render finds {longest} Gaussians in one tile and counts to {MOST_IN_TILE}: render "
            "smaller Gaussians, or only those that are seen."
        )
    if pairs > MOST_PAIRS:
        raise InputError(
            f"render needs {pairs} pairs of Gaussian and tile, and its lists hold {MOST_PAIRS}: "
            "set views_at_once, or render smaller Gaussians."
        )
