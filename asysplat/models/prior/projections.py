"""Projections between views, and what follows from the cameras alone: neighbors, depth ranges."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.kernels.dispatch import to_float64
from asysplat.scene import Cameras

SAMPLES = 6  # points along each side of a view that stand for all its pixels
USEFUL_PARALLAX = 0.1  # parallax in image widths, beyond which more adds nothing
WIDE_PARALLAX = 0.5  # parallax in image widths, beyond which two views look too different
MIN_OVERLAP = 0.2  # fraction of a view that a neighbor must see at the nearest and farthest plane
OUTLIERS = 0.02  # fraction of the known depths at either end that a range ignores
MIN_POINTS = 16  # known depths that a range needs
MARGIN = 1.5  # factor that widens a range: surfaces without texture have no known depth
SUBPIXEL = 0.25  # error of a match, pixels


@dataclass(frozen=True)
class PairwiseProjections:
    """The projections between all pairs of views, for images of any size."""

    normalized: Float[Tensor, "B V V 3 4"]  # for images of width and height 1; see `matrices`
    dtype: torch.dtype  # type of the cameras' numbers

    @classmethod
    def from_cameras(cls, cameras: Cameras) -> "PairwiseProjections":
        """Compute the projections in float64."""
        poses = to_float64(cameras.cam_to_world)
        size = poses.new_tensor([1 / cameras.width, 1 / cameras.height, 1])
        intrinsics = size[:, None] * to_float64(cameras.intrinsics)
        relative = torch.linalg.inv(poses)[:, None] @ poses[:, :, None]
        rays = relative[..., :3, :3] @ torch.linalg.inv(intrinsics)[:, :, None]
        to_other = torch.cat((rays, relative[..., :3, 3:]), dim=-1)
        normalized = intrinsics[:, None] @ to_other
        return cls(normalized, cameras.intrinsics.dtype)

    def matrices(
        self, others: Int[Tensor, "B V K"], height: int, width: int
    ) -> Float[Tensor, "B V K 3 4"]:
        """Return M such that M (x, y, 1, inverse depth) is the homogeneous pixel in another view.

        Both images have `height` x `width` pixels; x and y count from the image's corner. The third
        coordinate is the depth in the other view over the depth in this one. The index -1 gives
        the first view.
        """
        size = self.normalized.new_tensor([width, height, 1])
        factors = torch.cat((1 / size, size.new_ones(1))) * size[:, None]
        index = others.clamp_min(0)[..., None, None].expand(-1, -1, -1, 3, 4)
        return (self.normalized.gather(2, index) * factors).to(self.dtype)


def choose_neighbors(
    cameras: Cameras, projections: PairwiseProjections, count: int
) -> Int[Tensor, "B V K"]:
    """Return for each view the neighbors with the most overlap and parallax; -1 for none.

    At each of several inverse depths, from 0 to many times the inverse of the views' distance,
    the overlap of two views is the fraction of pixels that both contain. Their score is the sum of
    the overlaps, each weighted by how useful the parallax is. K is at most `count` and V - 1, at
    least 1.
    """
    V = cameras.num_views
    apart = torch.cdist(cameras.centers, cameras.centers)
    largest = apart.amax((-1, -2)).clamp_min(1e-12)
    steps = torch.logspace(-1.5, 1.5, 11, base=10.0).to(apart)
    focal = cameras.intrinsics[..., 0, 0] / cameras.width
    inverse = torch.cat((steps.new_zeros(1), steps)) * 2 / (largest * focal.mean(-1))[:, None]
    every_view = torch.arange(V, device=apart.device).expand(len(apart), V, V)
    overlap = _inside(projections, every_view, inverse[:, None].expand(-1, V, -1)).mean(-2)
    parallax = focal[:, :, None, None] * apart[..., None] * inverse[:, None, None]
    useful = (parallax / USEFUL_PARALLAX).clamp_max(1) / (1 + (parallax / WIDE_PARALLAX) ** 2)
    score = (overlap * useful).sum(-1)
    # Centers closer than this differ by rounding only.
    score = score.masked_fill(apart < 1e-5 * cameras.centers.abs().amax((-1, -2))[:, None, None], 0)
    score.diagonal(dim1=-2, dim2=-1).fill_(0)
    # Stable, so that equal scores give the same views on every machine.
    order = score.argsort(dim=-1, descending=True, stable=True)[..., : min(count, max(V - 1, 1))]
    return order.masked_fill(score.gather(-1, order) <= 0, -1)


def inverse_depth_range(
    cameras: Cameras, projections: PairwiseProjections, neighbors: Int[Tensor, "B V K"]
) -> Float[Tensor, "B V 2"]:
    """Return the least and greatest inverse depth at which a neighbor sees MIN_OVERLAP of a view.

    Both are 0 for a view without neighbors; the least is 0 if the neighbors see points at infinity.
    """
    distance = _farthest(cameras, neighbors)
    steps = torch.logspace(-2, 2, 97, base=10.0).to(distance)
    focal = cameras.intrinsics[..., 0, 0] / cameras.width
    inverse = steps / (distance.clamp_min(1e-12) * focal)[..., None]
    seen = _inside(projections, neighbors, inverse) * (neighbors >= 0)[..., None, None]
    overlap = seen.amax(2).mean(-2)
    enough = overlap >= MIN_OVERLAP
    first = enough.int().argmax(-1, keepdim=True)
    last = enough.shape[-1] - 1 - enough.flip(-1).int().argmax(-1, keepdim=True)
    least = inverse.gather(-1, first).masked_fill(first == 0, 0)
    greatest = torch.where(
        enough.any(-1, keepdim=True), inverse.gather(-1, last), inverse[..., -1:]
    )
    ranges = torch.cat((least, greatest), dim=-1)
    return ranges.masked_fill((distance == 0)[..., None], 0)


def smallest_step(cameras: Cameras, neighbors: Int[Tensor, "B V K"]) -> Float[Tensor, "B V"]:
    """Return the inverse depth that moves a pixel by SUBPIXEL in the farthest neighbor's image."""
    pixels = cameras.intrinsics[..., 0, 0] * _farthest(cameras, neighbors)
    return torch.where(pixels > 0, SUBPIXEL / pixels.clamp_min(1e-30), 0)


def observed_range(
    inverse: Float[Tensor, "B V n"], known: Bool[Tensor, "B V n"]
) -> Float[Tensor, "B V 2"]:
    """Return the range of the known inverse depths with a margin; 0 and 0 if there are too few."""
    ordered = inverse.masked_fill(~known, torch.inf).sort(dim=-1).values
    count = known.sum(-1, keepdim=True)
    quantiles = inverse.new_tensor([OUTLIERS, 1 - OUTLIERS])
    index = (quantiles * (count - 1)).round().long().clamp(0, ordered.shape[-1] - 1)
    ranges = ordered.gather(-1, index) * ordered.new_tensor([1 / MARGIN, MARGIN])
    return torch.where(count >= MIN_POINTS, ranges, 0)


def _farthest(cameras: Cameras, neighbors: Int[Tensor, "B V K"]) -> Float[Tensor, "B V"]:
    """Return the distance of the farthest neighbor, 0 without any."""
    centers = cameras.centers
    scene = torch.arange(len(centers), device=centers.device)[:, None, None]
    distance = (centers[scene, neighbors.clamp_min(0)] - centers[:, :, None]).norm(dim=-1)
    return distance.masked_fill(neighbors < 0, 0).amax(-1)


def _inside(
    projections: PairwiseProjections, others: Int[Tensor, "B V K"], inverse: Float[Tensor, "B V n"]
) -> Float[Tensor, "B V K p n"]:
    """Return 1 for p points of a view, each at n inverse depths, if another view contains them."""
    u, v, z = projections.matrices(others, SAMPLES, SAMPLES).to(inverse).unbind(-2)
    # A point is inside where all of these are positive; then its depth is, too.
    sides = torch.stack((u, SAMPLES * z - u, v, SAMPLES * z - v), dim=-2)
    right, down, corner, per_depth = sides[..., None, None].unbind(-3)
    pixels = torch.arange(SAMPLES, device=inverse.device) + 0.5
    flat = right * pixels + down * pixels[:, None] + corner
    bound = -flat / per_depth
    never = (per_depth == 0) & (flat <= 0)
    least = torch.where(per_depth > 0, bound, torch.where(never, torch.inf, -torch.inf)).amax(3)
    greatest = torch.where(per_depth < 0, bound, torch.inf).amin(3)
    least, greatest = least.flatten(-2)[..., None], greatest.flatten(-2)[..., None]
    inverse = inverse[:, :, None, None]
    return ((inverse > least) & (inverse < greatest)).to(inverse)
