"""Surfaces from the depths of all views and from how many views confirm them."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.geometry.isotropic import isotropic_gaussians
from asysplat.models.prior.fill import color_edges, fill_unknown
from asysplat.models.prior.projections import PairwiseProjections
from asysplat.ops.plane_sweep import Consistency, load_backend
from asysplat.scene import Gaussians, TensorRecord, Views, decode

UNKNOWN_DISTANCE = 10**0.5  # the geometric mean of .1 and 100, the range of distances
VOTE_TOLERANCE = 0.05  # greatest relative difference of two inverse depths of the same surface
SURFACE_OPACITY = 0.9  # joint opacity of all views that confirm a surface
UNCERTAIN_SURFACE_OPACITY = 0.7  # the same of all views that may see a point of uncertain depth
FREE_OPACITY = 1e-4  # opacity in free space, too small to be drawn


@dataclass(frozen=True)
class DepthEstimate:
    """Depths of all views, and how many other views confirm them."""

    inverse_depth: Float[Tensor, "*batch V h w"]  # along the camera's z axis; 0 where unknown
    confidence: Float[Tensor, "*batch V h w"]  # in [0, 1]; 0 where no other view confirms the depth
    votes: Consistency  # see `count_votes`


@dataclass(frozen=True)
class Prior(TensorRecord):
    """Surfaces at the pixels of a grid on each view.

    The opacity is shared by the views that see the same surface, and FREE_OPACITY where nothing is
    to be drawn.
    """

    distance: Float[Tensor, "B V h w"]  # along a pixel's ray, > 0, in scene units
    opacity: Float[Tensor, "B V h w"]  # in (0, 1)

    @classmethod
    def from_estimate(cls, depth: DepthEstimate, views: Views, size: tuple[int, int]) -> "Prior":
        """Compute the prior of estimated depths, resized to the grid's size.

        A view's part of a surface's opacity follows from the number of views that confirm it;
        where no depth is sure, from the number of views that contain the point and do not see
        another surface in front of it. In free space, and in pixels that are masked out, wholly or
        in part, it is FREE_OPACITY.
        """
        votes = depth.votes
        alone = (votes.containing == 0).to(depth.confidence)
        sure = _per_view_opacity(SURFACE_OPACITY, votes.agreeing).logit()
        not_occluded = votes.containing - votes.occluding
        unsure = _per_view_opacity(UNCERTAIN_SURFACE_OPACITY, not_occluded).logit()
        opacity = unsure + (sure - unsure) * torch.maximum(depth.confidence, alone)
        inverse, opacity = (
            F.interpolate(values, size, mode="bilinear")
            for values in (depth.inverse_depth, opacity)
        )
        length = views.cameras.resized(*size).pixel_directions().norm(dim=-1)
        distance = torch.where(inverse > 0, length / inverse.clamp_min(1e-6), UNKNOWN_DISTANCE)
        dropped = F.interpolate(in_free_space(votes).to(opacity), size, mode="area") > 0.5
        if (surfaces := views.surfaces(size)) is not None:
            dropped = dropped | ~surfaces
        return cls(distance, opacity.sigmoid().masked_fill(dropped, FREE_OPACITY))

    @classmethod
    def from_depth_maps(
        cls, depths: Float[Tensor, "B V H W"], views: Views, size: tuple[int, int]
    ) -> "Prior":
        """Compute the prior of depth maps; gaps are filled from their surroundings."""
        scenes, count = views.images.shape[:2]
        known = (depths > 0).to(depths)
        stride = views.cameras.height // size[0]
        fraction = F.avg_pool2d(known, stride)
        inverse = F.avg_pool2d(known / depths.clamp_min(1e-6), stride)
        edges = color_edges(decode(views.resized(*size).images)).to(inverse)
        inverse = fill_unknown(inverse / fraction.clamp_min(1e-6), fraction, edges)
        others = other_views(count, scenes, inverse.device)
        projections = PairwiseProjections.from_cameras(views.cameras).matrices(others, *size)
        surfaces = views.surfaces(size)
        confidence = fraction if surfaces is None else fraction * surfaces
        votes = count_votes(inverse, confidence, others, projections)
        return cls.from_estimate(DepthEstimate(inverse, confidence, votes), views, size)

    def gaussians(self, views: Views, spread: float) -> Gaussians:
        """Place an isotropic Gaussian [B, V h w] at the surface point of each pixel of the grid.

        Its standard deviation is `spread` pixels of the grid.
        """
        size = tuple(self.distance.shape[-2:])
        cameras = views.cameras.resized(*size)
        origins, directions = cameras.rays()
        distance = self.distance.to(directions)
        colors = decode(views.resized(*size).images).flatten(0, 1).movedim(1, -1)
        gaussians = isotropic_gaussians(
            (origins + distance[..., None] * directions).flatten(0, 3),
            (distance / cameras.intrinsics[..., 0, 0, None, None] * spread).flatten(),
            self.opacity.to(directions).flatten(),
            colors.flatten(0, 2),
        )
        return gaussians.map(lambda field: field.unflatten(0, (len(distance), -1)))


def count_votes(
    inverse: Float[Tensor, "B V h w"],
    trust: Float[Tensor, "B V h w"],
    others: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    backend: str = "auto",
) -> Consistency:
    """Count the views that see each pixel's point, see through it, or do not; see `Consistency`."""
    consistency = load_backend(backend, inverse).consistency
    steps = torch.zeros_like(inverse[..., 0, 0])
    return consistency(inverse, steps, trust, others, projections, tolerance=VOTE_TOLERANCE)


def in_free_space(votes: Consistency) -> Bool[Tensor, "B V h w"]:
    """Return the pixels whose point other views see through, to a surface behind it.

    The views that see through a point must outnumber twice those that confirm it by more than one.
    A point that only one view sees is kept, and so is one that only one other view contradicts.
    """
    return votes.contradicting > 2 * votes.agreeing + 1


def other_views(views: int, scenes: int, device: torch.device) -> Int[Tensor, "B V K"]:
    """Return for each view the indices of all others; -1 for a single view."""
    if views == 1:
        return torch.full((scenes, 1, 1), -1, device=device)
    following = torch.arange(1, views, device=device) + torch.arange(views, device=device)[:, None]
    return (following % views).expand(scenes, -1, -1)


def _per_view_opacity(
    total: float, other_views: Float[Tensor, "B V h w"]
) -> Float[Tensor, "B V h w"]:
    """Return the opacity at which a view and `other_views` more reach the opacity `total`."""
    return 1 - (1 - total) ** (1 / (1 + other_views))
