"""Where a scene's Gaussians start: on surfaces that are known, or at sparse points."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from asysplat.errors import InputError
from asysplat.models.head import SH_C0
from asysplat.models.prior import Prior
from asysplat.scene import Cameras, Gaussians, Views

SPREAD = 0.5  # standard deviation of a Gaussian, in sides of the cell that it stands for
NEIGHBORS = 3  # of a point: their mean distance is its size (Kerbl et al. 2023)
FAINT = 0.1  # opacity of a point


def gaussians_of_prior(views: Views, prior: Prior) -> Gaussians:
    """Put a round Gaussian where each pixel of a prior's grid sees its surface.

    Pixels that are masked out, wholly or in part, get none, unless there are no others.

    Args:
        views: [V].
        prior: of these, [1, V, h, w].
    """
    size = tuple(prior.distance.shape[-2:])
    cameras = views.cameras.resized(*size)
    origins, directions = cameras.rays()
    distance = prior.distance[0].to(directions)
    small = F.interpolate(views.images, size, mode="area").movedim(1, -1)
    gaussians = round_gaussians(
        (origins + distance[..., None] * directions).flatten(0, 2),
        (distance / cameras.intrinsics[:, 0, 0, None, None] * SPREAD).flatten(),
        prior.opacity[0].to(directions).flatten(),
        small.flatten(0, 2),
    )
    if views.masks is None:
        return gaussians
    counts = F.interpolate(views.masks[:, None].float(), size, mode="area").flatten() == 1
    return gaussians.keep(counts) if counts.any() else gaussians


def gaussians_of_points(points: Float[Tensor, "P 3"], views: Views) -> Gaussians:
    """Put a faint round Gaussian at each sparse point, as Kerbl et al. (2023) start.

    Args:
        points: in the world of the views.
        views: [V]; a point's color is the mean of the pixels that it falls on.

    Raises:
        InputError: no points, or one that is NaN or infinite.
    """
    if len(points) == 0 or not points.isfinite().all():
        raise InputError(
            f"gaussians_of_points got {len(points)} points with {int((~points.isfinite()).sum())} "
            "coordinates that are NaN or infinite: give at least one point, and finite numbers."
        )
    # No point is smaller than a pixel: neither one that is alone nor two at one place.
    sizes = footprints(points, views.cameras)
    if len(points) > 1:
        ranks = range(2, min(NEIGHBORS + 1, len(points)) + 1)  # the first is the point itself
        distances = cKDTree(points.numpy()).query(points.numpy(), k=list(ranks))[0]
        sizes = torch.maximum(sizes, torch.as_tensor(distances.mean(-1)).to(points))
    return round_gaussians(points, sizes, torch.full_like(sizes, FAINT), colors_at(points, views))


def round_gaussians(
    means: Float[Tensor, "N 3"],
    sizes: Float[Tensor, "N"],
    opacities: Float[Tensor, "N"],
    colors: Float[Tensor, "N 3"],
) -> Gaussians:
    """Return Gaussians of one standard deviation, with the same color from everywhere."""
    quats = torch.zeros(len(means), 4).to(means)
    quats[:, 0] = 1
    return Gaussians(
        means=means,
        quats=quats,
        scales=sizes[:, None].repeat(1, 3),
        opacities=opacities,
        sh=((colors - 0.5) / SH_C0)[:, None],
    )


def seen_at(
    points: Float[Tensor, "N 3"], cameras: Cameras
) -> tuple[Float[Tensor, "V N 2"], Float[Tensor, "V N"]]:
    """Return where points fall in each image, in pixels, and their depth; 0 outside an image."""
    rotation = cameras.cam_to_world[:, :3, :3]
    local = (points - cameras.centers[:, None]) @ rotation
    depth = local[..., 2]
    pixels = (local @ cameras.intrinsics.mT)[..., :2] / depth.clamp_min(1e-12)[..., None]
    size = pixels.new_tensor([cameras.width, cameras.height])
    inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(-1)
    return pixels, depth.where(inside, 0)


def footprints(points: Float[Tensor, "N 3"], cameras: Cameras) -> Float[Tensor, "N"]:
    """Return what a pixel covers at each point: the least over the cameras that see it.

    For a point that no camera sees, it is the least that a camera would see, looking there.
    """
    focal = cameras.intrinsics[:, 0, 0]
    finest = torch.full_like(points[:, 0], torch.inf)
    anyhow = finest.clone()
    for view in range(cameras.num_views):
        one = cameras.select([view])
        _, depth = seen_at(points, one)
        size = depth[0] / focal[view]
        finest = torch.minimum(finest, size.where(depth[0] > 0, torch.inf))
        anyhow = torch.minimum(anyhow, (points - one.centers).norm(dim=-1) / focal[view])
    return torch.where(finest.isfinite(), finest, anyhow).clamp_min(torch.finfo(points.dtype).tiny)


def colors_at(points: Float[Tensor, "N 3"], views: Views) -> Float[Tensor, "N 3"]:
    """Return the mean color of the pixels that points fall on; gray where none of them counts."""
    total, count = torch.zeros_like(points), torch.zeros_like(points[:, :1])
    for view in range(views.num_views):
        pixels, depth = seen_at(points, views.cameras.select([view]))
        seen = depth[0].nonzero()[:, 0]
        column, row = pixels[0, seen].long().unbind(-1)
        if views.masks is not None:
            counts = views.masks[view, row, column]
            seen, row, column = seen[counts], row[counts], column[counts]
        total[seen] += views.images[view, :, row, column].mT
        count[seen] += 1
    return torch.where(count > 0, total / count.clamp_min(1), 0.5)
