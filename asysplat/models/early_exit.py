"""Early exit: thresholds above which a prediction skips layers or the whole network.

The results are no longer exact; the values of conf/speed/ were chosen from measured curves.
"""

from dataclasses import dataclass, fields

from asysplat.errors import InputError


@dataclass(frozen=True)
class EarlyExit:
    """Thresholds of the prior's mean confidence in a scene, in (0, 1]; None skips nothing.

    Args:
        skip_layers_above: skip the network's `skippable_layers` from this confidence on.
        skip_network_above: skip the network: the Gaussians are the prior's own.
    """

    skip_layers_above: float | None = None
    skip_network_above: float | None = None

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not 0 < value <= 1:
                raise InputError(
                    f"speed.{field.name}={value}: give a number above 0 and up to 1, or null to "
                    "skip nothing."
                )


EXACT = EarlyExit()
