"""The Gaussians that a refinement starts from, by name."""

import torch
import torch.nn.functional as F
from torch import nn

from asysplat.errors import InputError
from asysplat.models.network import Network
from asysplat.models.prior import DepthPrior, PlaneSweepPrior
from asysplat.refinement.merge import thinned
from asysplat.refinement.photographs import Photographs
from asysplat.refinement.start import gaussians_of_points, gaussians_of_prior
from asysplat.scene import Gaussians, Views

INITS = ("network", "sweep", "points", "depth")
GRID = 64  # longest side of a prior's grid: what the sweep compares
LOOKED_AT = 128  # longest side of what a network sees
FEW = 8  # views up to which the network adds to the sweep (checkpoints/asysplat_plane_sweep.md)


def best_init(views: int) -> str:
    """Return the better start: the network's where views are few, else the sweep's."""
    return "network" if views <= FEW else "sweep"


@torch.no_grad()
def initial_gaussians(
    init: str, photographs: Photographs, most: int, network: Network | None = None
) -> Gaussians:
    """Return at most `most` Gaussians to refine, in the network's frame.

    Those of several views that say the same are merged: a cell is a pixel of the grid that they
    were found on.

    Args:
        init: one of INITS.
        photographs: of the scene.
        most: Gaussians.
        network: of init=network.

    Raises:
        InputError: an unknown init, or photographs without what it needs.
    """
    views = photographs.inputs
    height, width = views.cameras.height, views.cameras.width
    if init == "points":
        if photographs.points is None:
            raise InputError(
                f"init=points: {photographs.name} has no sparse points; choose sweep, or a layout "
                "with points (COLMAP)."
            )
        return thinned(gaussians_of_points(photographs.points, views), views.cameras, 1.0, most)
    if init == "network":
        seen = _resized(views, LOOKED_AT, network.size_multiple)
        found = network.eval()(seen)
        grid = GRID
    elif init in ("sweep", "depth"):
        if init == "depth" and views.depths is None:
            raise InputError(
                f"init=depth: {photographs.name} has no depth maps; choose sweep or points."
            )
        prior = _prior(PlaneSweepPrior() if init == "sweep" else DepthPrior(), views)
        found, grid = gaussians_of_prior(views, prior), max(prior.distance.shape[-2:])
    else:
        raise InputError(f"init={init}: choose {', '.join(INITS)}, or a file of Gaussians.")
    return thinned(found, views.cameras, max(1.0, max(height, width) / grid), most)


def _prior(prior: nn.Module, views: Views):
    """Ask a prior for a grid of at most GRID pixels, whose sides divide those of the views."""
    side = max(1, -(-max(views.cameras.height, views.cameras.width) // GRID))
    views = _resized(views, max(views.cameras.height, views.cameras.width), side)
    size = views.cameras.height // side, views.cameras.width // side
    return prior(views.map(lambda tensor: tensor[None]), size)


def _resized(views: Views, longest: int, multiple: int) -> Views:
    """Return views whose longer side is about `longest` and whose sides are multiples."""
    cameras = views.cameras
    scale = min(1.0, longest / max(cameras.height, cameras.width))
    size = [
        max(multiple, round(side * scale / multiple) * multiple)
        for side in (cameras.height, cameras.width)
    ]
    depths = views.depths
    if depths is not None:
        depths = F.interpolate(depths[:, None], size, mode="nearest")[:, 0]
    return Views(
        cameras.resized(*size), F.interpolate(views.images, size, mode="area"), depths=depths
    )
