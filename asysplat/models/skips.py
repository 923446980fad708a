"""What a network need not compute: layers of a scene that the prior knows, and faint Gaussians."""

from typing import Annotated

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass

from asysplat.ranges import Fraction, PositiveFraction, configured
from asysplat.scene import Gaussians


@dataclass(frozen=True, config=configured("speed"))
class EarlyExit:
    """Thresholds of the prior's mean confidence in a scene, in (0, 1]; None skips nothing.

    Args:
        skip_layers_above: skip the network's `skippable_layers` from this confidence on.
        skip_network_above: skip the network: the Gaussians are the prior's own.
    """

    skip_layers_above: PositiveFraction | None = None
    skip_network_above: PositiveFraction | None = None


EXACT = EarlyExit()


@dataclass(frozen=True, config=configured("model.prune"))
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

    prune_ratio: Annotated[float, Field(ge=0, lt=1)]
    random_ratio: Fraction = 0.0

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
