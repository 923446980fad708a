"""What is known of the surfaces before a network looks: ours, not the paper's.

A prior is called with views and the size of the head's grid. It tells the tokenizers a distance
and a confidence for each pixel, and gives the head a distance to correct and an opacity to start
from: views that see the same surface share it. Without one (`model/prior=none`) the network is the
paper's.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from asysplat.ops import plane_sweep
from asysplat.ops.plane_sweep import NEIGHBORS, PLANES, SweptDepth
from asysplat.ops.plane_sweep.agreement import Depths, fill, other_views, votes
from asysplat.ops.plane_sweep.cameras import Projections, observed_range
from asysplat.ops.plane_sweep.images import shrink
from asysplat.scene import TensorRecord, Views

PRIOR_CHANNELS = 2
UNKNOWN = 10**0.5  # a distance for what nobody knows, the middle of PhotographHead's range
COVER = 0.95  # of what lies behind, hidden by all views that are sure of a surface together,
UNSURE_COVER = 0.7  # and by all that see a place where none is sure
SPREAD = (0, 1, 2, 4)  # blocks around a point: one farther away is trusted a quarter less
LONGEST_SIDE = 128  # of the images that are swept: twice the planes
BLOCK = 2  # swept pixels along a side that share a depth: two compare better than one


@dataclass(frozen=True)
class Prior(TensorRecord):
    """Distances and how far to trust them.

    Args:
        distance: along the ray of each pixel of the head's grid, > 0, in scene units.
        confidence: in [0, 1].
        opacity: to start from, in (0, 1).
    """

    distance: Float[Tensor, "B V h w"]
    confidence: Float[Tensor, "B V h w"]
    opacity: Float[Tensor, "B V h w"]

    @property
    def knows_something(self) -> Bool[Tensor, "B 1 1 1"]:
        """Tell the scenes of which any depth is known."""
        return (self.confidence > 0).flatten(1).any(dim=-1)[:, None, None, None]

    @classmethod
    def of_depths(cls, found: SweptDepth, views: Views, size: tuple[int, int]) -> "Prior":
        """Return the prior of depths along the z axis, 0 where unknown, at the grid's size."""
        alone = (found.within == 0).to(found.confidence)
        sure = _share(COVER, found.same).logit()
        unsure = _share(UNSURE_COVER, found.within).logit()
        start = unsure + (sure - unsure) * torch.maximum(found.confidence, alone)
        inverse, confidence, start = (
            F.interpolate(each, size, mode="bilinear")
            for each in (found.inverse_depth, found.confidence, start)
        )
        length = views.cameras.resized(*size).pixel_directions().norm(dim=-1)
        distance = torch.where(inverse > 0, length / inverse.clamp_min(1e-6), UNKNOWN)
        return cls(distance, confidence, start.sigmoid())

    @classmethod
    def of_known_depths(
        cls,
        inverse: Float[Tensor, "B V h w"],
        known: Float[Tensor, "B V h w"],
        confidence: Float[Tensor, "B V h w"],
        views: Views,
    ) -> "Prior":
        """Return the prior of depths that are given, filled where `known` is less than 1."""
        scenes, count, *size = inverse.shape
        inverse = fill(inverse, known)
        everyone = other_views(count, scenes, inverse.device)
        others = votes(
            Depths(inverse, torch.zeros_like(inverse[..., 0, 0])),
            everyone,
            Projections.between(views.cameras).into(everyone, *size),
            trust=confidence,
        )
        found = SweptDepth(inverse, confidence, others.same, others.within)
        return cls.of_depths(found, views, tuple(size))

    def features(self, height: int, width: int) -> Float[Tensor, "B V H W 2"]:
        """Return the logarithm of the distance, over the scene's middle, and the confidence.

        Both are in about [-1, 1]. Places and things, seen from near and far, look alike.
        """
        ordered = self.distance.flatten(1).sort(dim=-1).values
        middle = ordered[:, (ordered.shape[1] - 1) // 2, None, None, None]
        maps = ((self.distance / middle).log().clamp(-4, 4) / 2, self.confidence * 2 - 1)
        return torch.stack(
            [F.interpolate(each, (height, width), mode="bilinear") for each in maps], dim=-1
        )


class PlaneSweepPrior(nn.Module):
    """Depth from a plane sweep over each view's neighbors (`asysplat.ops.plane_sweep`).

    Large images are swept at a size that suits the number of planes. How far is swept follows from
    the cameras, and in views that see enough sparse points from those.

    Args:
        planes, neighbors: see `plane_sweep`.
        longest_side: of the images that are swept, pixels.
    """

    def __init__(
        self, planes: int = PLANES, neighbors: int = NEIGHBORS, longest_side: int = LONGEST_SIDE
    ):
        super().__init__()
        self.planes, self.neighbors, self.longest_side = planes, neighbors, longest_side

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        height, width, factor = views.cameras.height, views.cameras.width, 1
        while max(height, width) > self.longest_side * factor:
            factor *= 2
        multiple = factor * BLOCK
        small = views.cameras.resized(
            max(1, height // multiple) * BLOCK, max(1, width // multiple) * BLOCK
        )
        images = shrink(views.images, small.height, small.width)
        ranges = _ranges(views.point_depths, factor)
        found = plane_sweep(
            images,
            small,
            stride=BLOCK,
            planes=self.planes,
            neighbors=self.neighbors,
            ranges=ranges,
        )
        return Prior.of_depths(found, views, size)


class DepthPrior(nn.Module):
    """The depths that come with the data, where there are any; gaps are filled from around."""

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        inverse, share = _blocks(views.depths, views, size)
        return Prior.of_known_depths(inverse, share, share, views)


class PointsPrior(nn.Module):
    """The depths of the scene's sparse points, spread to what lies around them.

    The data gives them with `data.points=true`; without any, all is unknown.
    """

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        inverse, share = _blocks(views.point_depths, views, size)
        known = (share > 0).to(share)
        spread = [F.max_pool2d(known, 2 * r + 1, stride=1, padding=r) for r in SPREAD]
        confidence = torch.stack(spread).mean(0)
        return Prior.of_known_depths(inverse, known, confidence, views)


def _ranges(depths: Float[Tensor, "B V H W"] | None, factor: int) -> Float[Tensor, "B V 2"] | None:
    """Return the least and greatest inverse depth that points suggest; 0 and 0 where few are seen.

    Args:
        depths: of points.
        factor: side of the blocks of pixels of which the nearest point counts.
    """
    if depths is None:
        return None
    inverse = F.max_pool2d((depths > 0) / depths.clamp_min(1e-6), factor).flatten(2)
    return observed_range(inverse, inverse > 0)


def _share(cover: float, others: Float[Tensor, "B V h w"]) -> Float[Tensor, "B V h w"]:
    """Return the opacity with which a view and as many others hide `cover` together."""
    return 1 - (1 - cover) ** (1 / (1 + others))


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
