"""What to sweep: which views see the same as a view, and at which depths. Cameras decide alone."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.scene import Cameras

SAMPLES = 6  # points along each side of a view that stand for all its pixels
USEFUL_PARALLAX = 0.1  # in image widths: more adds nothing,
WIDE_PARALLAX = 0.5  # and from here on two views look too different
LEAST_SHARE = 0.2  # of a view that a neighbor sees at the nearest plane
OUTLIERS = 0.02  # share of the depths that are known, at either end, that do not count for a range,
FEWEST = 16  # how many it takes to tell one
MARGIN = 1.5  # and how much wider it is: surfaces without texture are not known
SUBPIXEL = 0.25  # pixels by which matches are off
FRONT = 1e-6  # least depth in front of a camera, over the depth in the other


@dataclass(frozen=True)
class Projections:
    """Where all views have each other's pixels: from the cameras once, for images of any size.

    Args:
        unit: of images one wide and one high, as `into` describes them.
        dtype: of the cameras.
    """

    unit: Float[Tensor, "B V V 3 4"]
    dtype: torch.dtype

    @classmethod
    def between(cls, cameras: Cameras) -> "Projections":
        """Compute them in float64."""
        poses = cameras.cam_to_world.to(torch.float64)
        size = poses.new_tensor([1 / cameras.width, 1 / cameras.height, 1])
        intrinsics = size[:, None] * cameras.intrinsics.to(torch.float64)
        relative = torch.linalg.inv(poses)[:, None] @ poses[:, :, None]
        rays = relative[..., :3, :3] @ torch.linalg.inv(intrinsics)[:, :, None]
        moved = torch.cat((rays, relative[..., :3, 3:]), dim=-1)
        unit = intrinsics[:, None] @ moved
        return cls(unit, cameras.intrinsics.dtype)

    def into(
        self, others: Int[Tensor, "B V K"], height: int, width: int
    ) -> Float[Tensor, "B V K 3 4"]:
        """Return M with which (x, y, 1, inverse depth) of a view is another's homogeneous pixel.

        Both have `height` x `width` pixels; x and y are counted from the image's corner. The third
        coordinate is the other's depth over the view's own. A view of -1 stands for the first.
        """
        size = self.unit.new_tensor([width, height, 1])
        factors = torch.cat((1 / size, size.new_ones(1))) * size[:, None]
        index = others.clamp_min(0)[..., None, None].expand(-1, -1, -1, 3, 4)
        return (self.unit.gather(2, index) * factors).to(self.dtype)


def choose_neighbors(
    cameras: Cameras, projections: Projections, count: int
) -> Int[Tensor, "B V K"]:
    """Return the views that see most of what a view sees, from elsewhere; -1 for none.

    Two views are scored by the share of pixels that both see at inverse depths from 0 to many
    times the inverse of their distance, where the parallax is useful but not too wide. K is at
    most `count` and V - 1, at least 1.
    """
    V = cameras.num_views
    apart = torch.cdist(cameras.centers, cameras.centers)
    largest = apart.amax((-1, -2)).clamp_min(1e-12)
    steps = torch.logspace(-1.5, 1.5, 11, base=10.0).to(apart)
    focal = cameras.intrinsics[..., 0, 0] / cameras.width
    inverse = torch.cat((steps.new_zeros(1), steps)) * 2 / (largest * focal.mean(-1))[:, None]
    everyone = torch.arange(V, device=apart.device).expand(len(apart), V, V)
    seen = _sees(projections, everyone, inverse[:, None].expand(-1, V, -1)).mean(-2)
    parallax = focal[:, :, None, None] * apart[..., None] * inverse[:, None, None]
    useful = (parallax / USEFUL_PARALLAX).clamp_max(1) / (1 + (parallax / WIDE_PARALLAX) ** 2)
    score = (seen * useful).sum(-1)
    # Nearer than this, two centers differ by rounding.
    score = score.masked_fill(apart < 1e-5 * cameras.centers.abs().amax((-1, -2))[:, None, None], 0)
    score.diagonal(dim1=-2, dim2=-1).fill_(0)
    # Stable, so that equal scores give the same views on every machine.
    order = score.argsort(dim=-1, descending=True, stable=True)[..., : min(count, max(V - 1, 1))]
    return order.masked_fill(score.gather(-1, order) <= 0, -1)


def inverse_depth_range(
    cameras: Cameras, projections: Projections, neighbors: Int[Tensor, "B V K"]
) -> Float[Tensor, "B V 2"]:
    """Return the least and the greatest inverse depth at which neighbors see enough of a view.

    Both are 0 for a view without neighbors; the least is 0 where infinity is seen.
    """
    distance = _farthest(cameras, neighbors)
    steps = torch.logspace(-2, 2, 97, base=10.0).to(distance)
    focal = cameras.intrinsics[..., 0, 0] / cameras.width
    inverse = steps / (distance.clamp_min(1e-12) * focal)[..., None]
    share = _sees(projections, neighbors, inverse).amax(2).mean(-2)
    enough = share >= LEAST_SHARE
    first = enough.int().argmax(-1, keepdim=True)
    last = enough.shape[-1] - 1 - enough.flip(-1).int().argmax(-1, keepdim=True)
    least = inverse.gather(-1, first).masked_fill(first == 0, 0)
    greatest = torch.where(
        enough.any(-1, keepdim=True), inverse.gather(-1, last), inverse[..., -1:]
    )
    ranges = torch.cat((least, greatest), dim=-1)
    return ranges.masked_fill((distance == 0)[..., None], 0)


def least_step(cameras: Cameras, neighbors: Int[Tensor, "B V K"]) -> Float[Tensor, "B V"]:
    """Return the inverse depth that moves a pixel by SUBPIXEL in the farthest neighbor's image."""
    pixels = cameras.intrinsics[..., 0, 0] * _farthest(cameras, neighbors)
    return torch.where(pixels > 0, SUBPIXEL / pixels.clamp_min(1e-30), 0)


def observed_range(
    inverse: Float[Tensor, "B V n"], known: Bool[Tensor, "B V n"]
) -> Float[Tensor, "B V 2"]:
    """Return the least and greatest inverse depth that those known suggest; 0 and 0 of too few."""
    ordered = inverse.masked_fill(~known, torch.inf).sort(dim=-1).values
    count = known.sum(-1, keepdim=True)
    shares = inverse.new_tensor([OUTLIERS, 1 - OUTLIERS])
    index = (shares * (count - 1)).round().long().clamp(0, ordered.shape[-1] - 1)
    ranges = ordered.gather(-1, index) * ordered.new_tensor([1 / MARGIN, MARGIN])
    return torch.where(count >= FEWEST, ranges, 0)


def _farthest(cameras: Cameras, neighbors: Int[Tensor, "B V K"]) -> Float[Tensor, "B V"]:
    """Return the distance of the farthest neighbor, 0 without any."""
    centers = cameras.centers
    scene = torch.arange(len(centers), device=centers.device)[:, None, None]
    distance = (centers[scene, neighbors.clamp_min(0)] - centers[:, :, None]).norm(dim=-1)
    return distance.masked_fill(neighbors < 0, 0).amax(-1)


def _sees(
    projections: Projections, others: Int[Tensor, "B V K"], inverse: Float[Tensor, "B V n"]
) -> Float[Tensor, "B V K p n"]:
    """Return 1 for p points of a view, each at n inverse depths, that are within another view."""
    u, v, z = projections.into(others, SAMPLES, SAMPLES).to(inverse).unbind(-2)
    # Within are those for which all of these are positive; their depth is, too.
    sides = torch.stack((u, SAMPLES * z - u, v, SAMPLES * z - v), dim=-2)
    right, down, corner, away = sides[..., None, None].unbind(-3)
    pixels = torch.arange(SAMPLES, device=inverse.device) + 0.5
    flat = right * pixels + down * pixels[:, None] + corner
    bound = -flat / away
    never = (away == 0) & (flat <= 0)
    least = torch.where(away > 0, bound, torch.where(never, torch.inf, -torch.inf)).amax(3)
    greatest = torch.where(away < 0, bound, torch.inf).amin(3)
    least, greatest = least.flatten(-2)[..., None], greatest.flatten(-2)[..., None]
    inverse = inverse[:, :, None, None]
    return ((inverse > least) & (inverse < greatest)).to(inverse)
