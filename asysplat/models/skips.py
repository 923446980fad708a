"""What a network need not compute: layers of a scene that the prior knows, and faint Gaussians."""

from dataclasses import dataclass, fields

import torch

from asysplat.errors import InputError
from asysplat.scene import Gaussians


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


@dataclass(frozen=True)
class Prune:
    """Keep the most opaque Gaussians and a few of the rest, so that these learn too.

    The public settings are 0.6 and 0.1 (arthurhero/Long-LRM,
    configs/dl3dv_i540_32input_8target.yaml), the paper's Table 4 keeps half. There the rest is
    drawn at random; here it is evenly spaced by opacity, so that the same views give the same
    Gaussians.

    Args:
        prune_ratio: fraction of the Gaussians to drop, in [0, 1).
        random_ratio: fraction of the kept ones that is not chosen by opacity, in [0, 1].
    """

    prune_ratio: float
    random_ratio: float = 0.0

    def __post_init__(self):
        if not (0 <= self.prune_ratio < 1 and 0 <= self.random_ratio <= 1):
            raise InputError(
                f"model.prune: prune_ratio={self.prune_ratio} must be in [0, 1) and "
                f"random_ratio={self.random_ratio} in [0, 1]."
            )

    def __call__(self, gaussians: Gaussians) -> Gaussians:
        """Select among Gaussians [B, N], the same number in each scene."""
        count = gaussians.num_gaussians
        kept = max(1, int(count * (1 - self.prune_ratio)))
        if kept == count:
            return gaussians
        spaced = int(kept * self.random_ratio)
        opaque = kept - spaced
        order = gaussians.opacities.argsort(dim=-1, descending=True, stable=True)
        steps = torch.arange(spaced, device=order.device)
        ranks = opaque + steps * (count - opaque) // max(1, spaced)
        chosen = torch.cat((order[:, :opaque], order[:, ranks]), -1)
        rows = torch.arange(len(chosen), device=chosen.device)[:, None]
        return gaussians.map(lambda field: field[rows, chosen])
