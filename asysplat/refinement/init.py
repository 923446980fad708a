"""The Gaussians that a refinement starts from."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from asysplat.data.selection import evenly_spaced
from asysplat.errors import InputError
from asysplat.models.network import Network
from asysplat.models.prior import DepthPrior, PlaneSweepPrior, Prior
from asysplat.refinement.isotropic import footprints, isotropic_gaussians
from asysplat.refinement.merge import SPREAD, merge_to_limit
from asysplat.refinement.scaffold_gs import ScaffoldSettings
from asysplat.refinement.settings import RefinementSettings
from asysplat.rendering import INRIA
from asysplat.scene import Gaussians, Views

INITS = ("network", "plane_sweep", "points", "depth")
DEPTH_VIEWS = 64  # most views whose depths are used: with more, cells must be larger to hold fewer
PRIOR_MAX_SIDE = 64  # pixels of a prior's depth maps
NETWORK_MAX_SIDE = 128  # pixels of the network's input images
NEIGHBORS = 3  # the size of a point is their mean distance (Kerbl et al. 2023)
POINT_OPACITY = 0.1


@torch.no_grad()
def initial_gaussians(
    init: str,
    inputs: Views,
    settings: RefinementSettings | ScaffoldSettings,
    points: Float[Tensor, "P 3"] | None = None,
    network: Network | None = None,
) -> Gaussians:
    """Build the Gaussians that a refinement with `settings` starts from, in the frame of `inputs`.

    Of many views, those of DEPTH_VIEWS, evenly selected. Gaussians of several views on the same
    surface are merged, in cells of a pixel of the network's input or of the prior's depth map, or
    larger ones: `settings.initial_limit`.
    """
    pixels = 1.0
    views = inputs.select(
        evenly_spaced(range(inputs.num_views), min(DEPTH_VIEWS, inputs.num_views))
    )
    longest = max(views.cameras.height, views.cameras.width)
    if init == "points":
        if points is None:
            raise InputError(
                "init=points: the scene has no sparse points; choose plane_sweep, or a layout with "
                "points (COLMAP)."
            )
        gaussians = gaussians_from_points(points, inputs)
    elif init == "network":
        if network is None:
            raise InputError("init=network needs a network: give one, or choose plane_sweep.")
        small = _shrink(views, NETWORK_MAX_SIDE, network.patch)
        gaussians = without_invisible(network.eval()(small))
        pixels = longest / max(small.cameras.height, small.cameras.width)
    elif init in ("plane_sweep", "depth"):
        if init == "depth" and views.depths is None:
            raise InputError("init=depth: there are no depth maps; choose plane_sweep or points.")
        # Depth maps of PRIOR_MAX_SIDE pixels a side at most, a divisor of the views.
        stride = -(-longest // PRIOR_MAX_SIDE)
        small = _shrink(views, longest, stride)
        size = small.cameras.height // stride, small.cameras.width // stride
        run_prior = PlaneSweepPrior() if init == "plane_sweep" else DepthPrior()
        prior = run_prior(small.map(lambda tensor: tensor[None]), size)
        gaussians = gaussians_from_prior(views, prior)
        pixels = longest / max(prior.distance.shape[-2:])
    else:
        raise InputError(f"init={init}: choose {', '.join(INITS)}, or a file of Gaussians.")
    return merge_to_limit(gaussians, views.cameras, max(1.0, pixels), settings.initial_limit)


def gaussians_from_prior(views: Views, prior: Prior) -> Gaussians:
    """Place an isotropic Gaussian at the surface point of each pixel of a prior's depth maps.

    Those of opacities that are too small to be drawn are left out, unless that is all of them.
    """
    size = tuple(prior.distance.shape[-2:])
    cameras = views.cameras.resized(*size)
    origins, directions = cameras.rays()
    distance = prior.distance[0].to(directions)
    colors = F.interpolate(views.images, size, mode="area").movedim(1, -1)
    gaussians = isotropic_gaussians(
        (origins + distance[..., None] * directions).flatten(0, 2),
        (distance / cameras.intrinsics[:, 0, 0, None, None] * SPREAD).flatten(),
        prior.opacity[0].to(directions).flatten(),
        colors.flatten(0, 2),
    )
    return without_invisible(gaussians)


def without_invisible(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians that are opaque enough to be drawn; all if none is."""
    visible = gaussians.opacities >= INRIA.alpha_min
    return gaussians.keep(visible) if visible.any() else gaussians


def gaussians_from_points(points: Float[Tensor, "P 3"], views: Views) -> Gaussians:
    """Place a faint isotropic Gaussian at each sparse point, as Kerbl et al. (2023).

    It has the mean color of the point's pixels.
    """
    if len(points) == 0 or not points.isfinite().all():
        raise InputError(
            f"gaussians_from_points got {len(points)} points with "
            f"{int((~points.isfinite()).sum())} coordinates that are NaN or infinite: give at "
            "least one point, and finite numbers."
        )
    sizes = footprints(points, views.cameras)  # the minimum: for lone or coincident points
    if len(points) > 1:
        ranks = range(2, min(NEIGHBORS + 1, len(points)) + 1)  # the first is the point itself
        distances = KDTree(points.cpu()).query(points.cpu(), k=list(ranks))[0]
        sizes = torch.maximum(sizes, torch.as_tensor(distances.mean(-1)).to(points))
    opacities = torch.full_like(sizes, POINT_OPACITY)
    return isotropic_gaussians(points, sizes, opacities, sample_colors(points, views))


def sample_colors(points: Float[Tensor, "N 3"], views: Views) -> Float[Tensor, "N 3"]:
    """Compute the mean color of the pixels that points project to; gray if all are masked out."""
    total, count = torch.zeros_like(points), torch.zeros_like(points[:, :1])
    for view in range(views.num_views):
        pixels, _, inside = views.cameras.select([view]).project(points)
        visible = inside[0].nonzero()[:, 0]
        column, row = pixels[0, visible].long().unbind(-1)
        if views.masks is not None:
            valid = views.masks[view, row, column]
            visible, row, column = visible[valid], row[valid], column[valid]
        total[visible] += views.images[view, :, row, column].mT
        count[visible] += 1
    return torch.where(count > 0, total / count.clamp_min(1), 0.5)


def _shrink(views: Views, longest: int, multiple: int) -> Views:
    """Return views whose longer side is about `longest` and whose sides are multiples."""
    height, width = views.cameras.height, views.cameras.width
    scale = min(1.0, longest / max(height, width))
    size = (max(multiple, round(side * scale / multiple) * multiple) for side in (height, width))
    return views.resized(*size)
