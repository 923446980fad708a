"""Thresholds of what a prediction leaves out because its scene does not need it.

No result is the exact one any more: docs/results/skips.json has the measured curves from which the
values of conf/speed/ were chosen.
"""

from dataclasses import dataclass, fields

from asysplat.errors import InputError


@dataclass(frozen=True)
class EarlyExit:
    """Thresholds in (0, 1], or None where nothing is left out.

    All but `faint` look at the prior: a scene of which it knows nothing keeps its network, and a
    network without a prior takes no skips.

    Args:
        coverage: the share of what the input views see that those which meet the network have to
            see; the Gaussians of the others are the prior's own.
        sure: mean confidence of the prior from which a network leaves out what it names
            `dispensable`.
        known: mean confidence from which no view meets the network.
        faint: Gaussians of less opacity are dropped, none of which gives any pixel more than this
            share of its color.

    Raises:
        InputError: a threshold is out of range.
    """

    coverage: float | None = None
    sure: float | None = None
    known: float | None = None
    faint: float | None = None

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not 0 < value <= 1:
                raise InputError(
                    f"speed.{field.name}={value}: give a number above 0 and up to 1, or null to "
                    "leave nothing out."
                )


EXACT = EarlyExit()
