"""What is known of the surfaces before a network looks: ours, not the paper's.

A prior is called with views and the size of the head's grid. It tells the tokenizers a distance
and a confidence for each pixel, and gives the head a distance to correct and an opacity to start
from. Without one (`model/prior=none`) the network is the paper's.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.ops import plane_sweep
from asysplat.ops.plane_sweep import fill
from asysplat.scene import TensorRecord, Views

PRIOR_CHANNELS = 2
UNKNOWN = 10**0.5  # a distance for what nobody knows, the middle of PhotographHead's range
OUTLIERS = 0.02  # share of a view's points, at either end, that do not count for its range,
MARGIN = 2.0  # and how much wider it is: surfaces without texture have no points
FEWEST = 16  # points in a view that tell its range
SPREAD = (0, 1, 2, 4)  # blocks around a point: one farther away is trusted a quarter less
LONGEST_SIDE = 128  # of the images that are swept: twice the planes
BLOCK = 2  # swept pixels along a side that share a depth: two compare better than one


@dataclass(frozen=True)
class Prior(TensorRecord):
    """Distances and how far to trust them.

    Args:
        distance: along the ray of each pixel of the head's grid, > 0, in scene units.
        confidence: in [0, 1].
    """

    distance: Float[Tensor, "B V h w"]
    confidence: Float[Tensor, "B V h w"]

    @classmethod
    def of_inverse_depth(
        cls,
        inverse: Float[Tensor, "B V h w"],
        confidence: Float[Tensor, "B V h w"],
        views: Views,
        size: tuple[int, int],
    ) -> "Prior":
        """Return the prior of depths along the z axis, 0 where unknown, at the grid's size."""
        inverse = F.interpolate(inverse, size, mode="bilinear")
        length = views.cameras.resized(*size).pixel_directions().norm(dim=-1)
        distance = torch.where(inverse > 0, length / inverse.clamp_min(1e-6), UNKNOWN)
        return cls(distance, F.interpolate(confidence, size, mode="bilinear"))

    def features(self, height: int, width: int) -> Float[Tensor, "B V H W 2"]:
        """Return the logarithm of the distance and the confidence, both in about [-1, 1]."""
        maps = ((self.distance / UNKNOWN).log().clamp(-4, 4) / 2, self.confidence * 2 - 1)
        return torch.stack(
            [F.interpolate(each, (height, width), mode="bilinear") for each in maps], dim=-1
        )


class SweepPrior(nn.Module):
    """Depth from a plane sweep over each view's neighbours (`asysplat.ops.plane_sweep`).

    Large images are swept at a size that suits the number of planes. How far is swept follows from
    the cameras, and in views that see enough sparse points from those.
    """

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        height, width, factor = views.cameras.height, views.cameras.width, 1
        while max(height, width) > LONGEST_SIDE * factor:
            factor *= 2
        multiple = factor * BLOCK
        small = views.cameras.resized(
            max(1, height // multiple) * BLOCK, max(1, width // multiple) * BLOCK
        )
        images = F.interpolate(
            views.images.flatten(0, 1), (small.height, small.width), mode="area"
        ).unflatten(0, views.images.shape[:2])
        ranges = _ranges(views.point_depths, factor)
        found = plane_sweep(images, small, stride=BLOCK, ranges=ranges)
        return Prior.of_inverse_depth(found.inverse_depth, found.confidence, views, size)


class DepthPrior(nn.Module):
    """The depths that come with the data, where there are any; gaps are filled from around."""

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        inverse, share = _blocks(views.depths, views, size)
        return Prior.of_inverse_depth(fill(inverse, share), share, views, size)


class PointsPrior(nn.Module):
    """The depths of the scene's sparse points, spread to what lies around them.

    The data gives them with `data.points=true`; without any, all is unknown.
    """

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        inverse, share = _blocks(views.point_depths, views, size)
        known = (share > 0).to(share)
        spread = [F.max_pool2d(known, 2 * r + 1, stride=1, padding=r) for r in SPREAD]
        confidence = torch.stack(spread).mean(0)
        return Prior.of_inverse_depth(fill(inverse, known), confidence, views, size)


def _ranges(depths: Float[Tensor, "B V H W"] | None, factor: int) -> Float[Tensor, "B V 2"] | None:
    """Return the least and greatest inverse depth that points suggest; 0 and 0 where few are seen.

    Args:
        depths: of points.
        factor: side of the blocks of pixels of which the nearest point counts.
    """
    if depths is None:
        return None
    inverse = F.max_pool2d((depths > 0) / depths.clamp_min(1e-6), factor).flatten(2)
    ordered = inverse.sort(dim=-1).values  # pixels without a point come first
    count = (ordered > 0).sum(-1, keepdim=True)
    shares = ordered.new_tensor([OUTLIERS, 1 - OUTLIERS])
    index = ordered.shape[-1] - count + (shares * (count - 1)).round().long()
    ranges = ordered.gather(-1, index.clamp_max(ordered.shape[-1] - 1))
    return ranges.where(count >= FEWEST, 0) * ordered.new_tensor([1 / MARGIN, MARGIN])


def _blocks(
    depths: Float[Tensor, "B V H W"] | None, views: Views, size: tuple[int, int]
) -> tuple[Float[Tensor, "B V h w"], Float[Tensor, "B V h w"]]:
    """Return the mean inverse depth of each block of pixels, and the share that is known."""
    if depths is None:
        depths = torch.zeros_like(views.images[:, :, 0])
    known = (depths > 0).to(depths)
    stride = depths.shape[-2] // size[0]
    share = F.avg_pool2d(known, stride)
    inverse = F.avg_pool2d(known / depths.clamp_min(1e-6), stride) / share.clamp_min(1e-6)
    return inverse, share
