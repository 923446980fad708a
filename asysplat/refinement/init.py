"""What a refinement starts from: Gaussians, and depths that it keeps.

Gaussians are merged where several views show one surface.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from asysplat.data.selection import evenly_spaced
from asysplat.errors import InputError
from asysplat.geometry.isotropic import isotropic_gaussians
from asysplat.kernels.dispatch import to_float64
from asysplat.models.network import Network
from asysplat.models.prior import PlaneSweep, Prior
from asysplat.models.prior.plane_sweep import gaussians_of_estimate
from asysplat.models.prior.prior import DepthEstimate
from asysplat.refinement.footprints import footprints
from asysplat.refinement.hull import within_hull
from asysplat.rendering import INRIA
from asysplat.scene import Cameras, Gaussians, Views, decode

INITS = ("network", "plane_sweep", "points", "depth")
DEPTH_VIEWS = 64  # most views whose depths are used, evenly selected
PRIOR_MAX_SIDE = 64  # pixels of a prior's depth maps
NETWORK_MAX_SIDE = 128  # pixels of the network's input images
MIN_CONFIDENCE = 0.5  # least of a depth that is kept
MAX_ERROR = 0.5  # difference of log depths beyond which nothing is pulled: the sweep may be wrong
NEIGHBORS = 3  # the size of a point is their mean distance (Kerbl et al. 2023)
POINT_OPACITY = 0.1
SPREAD = 0.5  # standard deviation of a Gaussian, in sides of the cell that it covers


@torch.no_grad()
def initial_gaussians(
    init: str,
    inputs: Views,
    limit: int,
    points: Float[Tensor, "P 3"] | None = None,
    network: Network | None = None,
    estimate: DepthEstimate | None = None,
) -> Gaussians:
    """Build the Gaussians that a refinement starts from, `limit` at most, in the frame of `inputs`.

    Of many views, those of DEPTH_VIEWS: more would be merged in larger cells. Gaussians of several
    views on the same surface are merged, in cells of a pixel of the network's input or of the
    prior's depth map, or larger ones. An `estimate` is that of `sweep`, for init=plane_sweep.
    """
    pixels = 1.0
    views = inputs.select(depth_views(inputs))
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
        small = shrink_views(views, NETWORK_MAX_SIDE, network.patch)
        gaussians = without_invisible(network.eval()(small))
        pixels = longest / max(small.cameras.height, small.cameras.width)
    elif init in ("plane_sweep", "depth"):
        if init == "depth" and views.depths is None:
            raise InputError("init=depth: there are no depth maps; choose plane_sweep or points.")
        # Depth maps of PRIOR_MAX_SIDE pixels a side at most, a divisor of the views.
        stride = -(-longest // PRIOR_MAX_SIDE)
        small = shrink_views(views, longest, stride)
        size = small.cameras.height // stride, small.cameras.width // stride
        batch = small.map(lambda tensor: tensor[None])
        if init == "depth":
            assert batch.depths is not None  # refused above
            prior = Prior.from_depth_maps(batch.depths, batch, size)
        else:
            prior = Prior.from_estimate(estimate or sweep(inputs), batch, size)
        placed = prior.gaussians(views.map(lambda tensor: tensor[None]), SPREAD)
        gaussians = without_invisible(placed.map(lambda tensor: tensor[0]))
        pixels = longest / max(size)
    else:
        raise InputError(f"init={init}: choose {', '.join(INITS)}, or a file of Gaussians.")
    if inputs.alphas is not None:
        gaussians = within_hull(gaussians, inputs)
    return merge_to_limit(gaussians, views.cameras, max(1.0, pixels), limit)


@torch.no_grad()
def sweep(views: Views) -> DepthEstimate:
    """Estimate the depths of DEPTH_VIEWS at most, [1, V], by a plane sweep."""
    return PlaneSweep().sweep(views.select(depth_views(views)).map(lambda x: x[None]))


@torch.no_grad()
def gaussians_of_pixels(views: Views, estimate: DepthEstimate) -> Gaussians:
    """Place a Gaussian at the surface point of each pixel of the views of a `sweep`.

    They are drawn as they are: merged ones are blurred until steps sharpen them.
    """
    batch = views.select(depth_views(views)).map(lambda tensor: tensor[None])
    gaussians = without_invisible(gaussians_of_estimate(estimate, batch).map(lambda x: x[0]))
    return gaussians if views.alphas is None else within_hull(gaussians, views)


class KnownDepths:
    """The depths of a `sweep` of views, where other views confirm them.

    Steps would give them up: without texture, photographs are drawn from wrong depths, too.
    """

    def __init__(self, views: Views, estimate: DepthEstimate):
        self._maps = torch.stack((estimate.inverse_depth[0], estimate.confidence[0]), dim=1)
        self._rows = {view: row for row, view in enumerate(depth_views(views))}

    def error(self, depth: Float[Tensor, "1 H W"], view: int) -> Tensor:
        """Compute the mean error of a view's log depths by confidence, 0 where it is below .5.

        An error is at most MAX_ERROR, and 0 where no Gaussian is, at depth 0.
        """
        if view not in self._rows:
            return depth.new_zeros(())
        maps = self._maps[self._rows[view], None].to(depth)
        inverse, confidence = F.interpolate(maps, depth.shape[-2:], mode="bilinear")[0, :, None]
        known = (confidence > MIN_CONFIDENCE) & (inverse > 0) & (depth > 0)
        error = (depth * inverse).where(known, 1).log().abs().clamp_max(MAX_ERROR)
        return (error * confidence).mean()


def depth_views(views: Views) -> list[int]:
    return evenly_spaced(range(views.num_views), min(DEPTH_VIEWS, views.num_views))


def without_invisible(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians that are opaque enough to be drawn; all if none is."""
    visible = gaussians.opacities >= INRIA.alpha_min
    return gaussians.keep(visible) if visible.any() else gaussians


def gaussians_from_points(points: Float[Tensor, "P 3"], views: Views) -> Gaussians:
    """Place a faint isotropic Gaussian at each point, of its mean color (Kerbl et al. 2023)."""
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
        total[visible] += decode(views.images[view, :, row, column]).mT
        count[visible] += 1
    return torch.where(count > 0, total / count.clamp_min(1), 0.5)


def shrink_views(views: Views, longest: int, multiple: int) -> Views:
    """Return views whose longer side is about `longest` and whose sides are multiples."""
    height, width = views.cameras.height, views.cameras.width
    scale = min(1.0, longest / max(height, width))
    size = (max(multiple, round(side * scale / multiple) * multiple) for side in (height, width))
    return views.resized(*size)


MIN_OPACITY, MAX_OPACITY = 0.05, 0.95  # range of merged opacities, so that they keep a gradient
CELL_GROWTH = 2**0.5  # factor by which cells grow until few enough Gaussians are left


def merge_cells(gaussians: Gaussians, cells: Float[Tensor, "N"]) -> Gaussians:
    """Merge the Gaussians of each cubic cell into their mean, weighted by opacity.

    The merged Gaussian has the opacity of all of them one behind the other, clamped to MIN_OPACITY
    and MAX_OPACITY, and is at least as large as its cell. The sides of the `cells`, > 0, in scene
    units, are rounded to powers of 2, so that cells of one size tile the space, from the minimum
    corner of all means.
    """
    cell, count = _cell_ids(gaussians.means, cells)
    weights = gaussians.opacities.clamp_min(1e-6)  # transparent Gaussians have a mean, too
    total = weights.new_zeros(count).index_add_(0, cell, weights)

    def mean(values: Tensor) -> Tensor:
        shape = (-1, *[1] * (values.ndim - 1))
        summed = values.new_zeros(count, *values.shape[1:])
        return summed.index_add_(0, cell, values * weights.view(shape)) / total.view(shape)

    log_transmittance = torch.log1p(-gaussians.opacities.clamp(max=0.999))
    opacities = 1 - weights.new_zeros(count).index_add_(0, cell, log_transmittance).exp()
    # q and -q are the same rotation: flip all quaternions of a cell to the side of its first.
    rows = torch.arange(len(cell), device=cell.device)
    first = rows.new_full((count,), len(cell)).scatter_reduce_(0, cell, rows, "amin")[cell]
    quats = F.normalize(gaussians.quats, dim=-1)
    opposite = (quats * quats[first]).sum(-1, keepdim=True) < 0
    scales = mean(gaussians.scales.log()).exp()
    return Gaussians(
        means=mean(gaussians.means),
        quats=F.normalize(mean(torch.where(opposite, -quats, quats)), dim=-1),
        scales=torch.maximum(scales, SPREAD * mean(cells.log()).exp()[:, None]),
        opacities=opacities.clamp(MIN_OPACITY, MAX_OPACITY),
        sh=mean(gaussians.sh),
    )


def merge_to_limit(
    gaussians: Gaussians, cameras: Cameras, pixels: float, max_gaussians: int
) -> Gaussians:
    """Merge Gaussians in cells of `pixels`, then larger ones until few enough are left.

    `pixels`, > 0, is the side of a cell in pixels of the view where these are smallest.
    """
    gaussians.validate("merge_to_limit's gaussians")
    cells = pixels * footprints(gaussians.means, cameras)
    extent = (gaussians.means.amax(0) - gaussians.means.amin(0)).max()
    largest = torch.maximum(2 * extent, cells.max())  # one cell holds all means
    while _cell_ids(gaussians.means, cells)[1] > max_gaussians and cells.min() < largest:
        cells = torch.minimum(CELL_GROWTH * cells, largest)
    return merge_cells(gaussians, cells)


def _cell_ids(
    means: Float[Tensor, "N 3"], cells: Float[Tensor, "N"]
) -> tuple[Int[Tensor, "N"], int]:
    """Return the id of each mean's cell, from 0, and the number of cells."""
    level, means = to_float64(cells).log2().round(), to_float64(means)
    offsets = means - means.amin(0)
    position = (offsets / (2**level)[:, None]).floor()
    ids, count = _ranks(level)
    for axis in position.unbind(-1):
        # By ranks, as three positions may not fit into one integer.
        along, length = _ranks(axis)
        ids, count = _ranks(ids * length + along)
    return ids, count


def _ranks(values: Tensor) -> tuple[Int[Tensor, "N"], int]:
    unique, ranks = values.unique(return_inverse=True)
    return ranks, len(unique)
