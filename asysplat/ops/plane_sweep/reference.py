"""The plane sweep's two kernels in torch, for any device and float type."""

from functools import reduce
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.ops.plane_sweep.cameras import FRONT

WINDOW = 5  # pixels along a side of the patches that are compared
BEST = 2  # neighbors that count at each plane: in the others the point may be hidden
UNSEEN = 1.0  # the cost where fewer see it: that of patches that have nothing in common
NOISE = 3e-4  # variance of a patch that says nothing
SMALL_STEP = 0.1  # the penalty for one plane more or less than the pixel before
LARGE_STEP = 0.6  # for more than that,
EDGE = 0.05  # half of it where the color changes by this
LEAST_WEIGHT = 0.05  # of a pixel's own costs
FLATTEST = 1e-9  # bend of a parabola that has a minimum
TOLERANCE = 0.01  # of an inverse depth, or half a step if that is more: two views agree
PLACES = 2**20  # whose votes are counted at a time


class Lowest(NamedTuple):
    """Where the costs of a pixel are least, in planes, and how much less than their mean."""

    plane: Float[Tensor, "B V h w"]
    contrast: Float[Tensor, "B V h w"]


class Votes(NamedTuple):
    """How many other views find the same, how many see through it, and in how many it would be."""

    same: Float[Tensor, "B V h w"]
    through: Float[Tensor, "B V h w"]
    within: Float[Tensor, "B V h w"]

    def agreement(self) -> Float[Tensor, "B V h w"]:
        """Return how far the others agree, in [0, 1]: 0 where none does."""
        return (2 * self.same / (self.same + self.through + 1)).clamp_max(1)


def match(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
    stride: int,
) -> Float[Tensor, "B V h w D"]:
    """Compute how little a pixel looks like its neighbors' pixels at each plane, from 0 to 2.

    1 - the zero-mean normalized cross-correlation of patches, which neither gain nor offset of an
    exposure changes; the mean of the best two neighbors, averaged over blocks of `stride`.
    """
    B, V, H, W = images.shape
    # An image's small variances would be lost beside large squares.
    images = images - images.mean((-2, -1), keepdim=True)
    costs = images.new_empty(B, V, H // stride, W // stride, planes)
    y, x = torch.meshgrid(
        torch.arange(H, device=images.device) + 0.5,
        torch.arange(W, device=images.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack((x, y, torch.ones_like(x))).to(images)
    for b in range(B):
        for v in range(V):
            inverse = _planes(ranges[b, v], planes)
            found = [
                _compare(images[b, v], images[b, other], matrix, pixels, inverse)
                for other, matrix in zip(neighbors[b, v].tolist(), projections[b, v], strict=True)
                if other >= 0
            ]
            unseen = images.new_full((planes, H, W), UNSEEN)
            while len(found) < BEST:
                found.append(unseen)
            best = torch.stack(found).sort(dim=0).values[:BEST].mean(0)
            costs[b, v] = F.avg_pool2d(best, stride).permute(1, 2, 0)
    return costs


def _planes(span: Float[Tensor, "2"], planes: int) -> Float[Tensor, "D"]:
    steps = torch.arange(planes, device=span.device).to(span)
    return span[0] + steps * ((span[1] - span[0]) / (planes - 1))


def _compare(
    image: Float[Tensor, "H W"],
    other: Float[Tensor, "H W"],
    matrix: Float[Tensor, "3 4"],
    pixels: Float[Tensor, "3 H W"],
    inverse: Float[Tensor, "D"],
) -> Float[Tensor, "D H W"]:
    """Return the cost of one neighbor at every plane; UNSEEN, or more, outside its image."""
    H, W = image.shape
    flat = torch.einsum("ij,jyx->iyx", matrix[:, :3], pixels)
    points = flat + inverse[:, None, None, None] * matrix[:, 3, None, None]
    x, y, z = points.unbind(1)
    front = z.clamp_min(FRONT)
    x, y = x / front, y / front
    seen = (z > FRONT) & (x > 0) & (x < W) & (y > 0) & (y < H)
    places = torch.stack((x / W, y / H), dim=-1).clamp(-1, 2) * 2 - 1
    warped = F.grid_sample(
        other.expand(len(places), 1, H, W), places, padding_mode="border", align_corners=False
    )[:, 0]
    mean, other_mean = patch_mean(image), patch_mean(warped)
    both = patch_mean(image * warped) - mean * other_mean
    variance = patch_mean(image**2) - mean**2
    other_variance = patch_mean(warped**2) - other_mean**2
    norm = (variance.clamp_min(0) + NOISE) * (other_variance.clamp_min(0) + NOISE)
    return torch.where(seen, 1 - both / norm.sqrt(), UNSEEN)


def patch_mean(values: Float[Tensor, "*more H W"]) -> Float[Tensor, "*more H W"]:
    """Return the mean over WINDOW x WINDOW pixels; beyond the border, its pixels go on."""
    H, W = values.shape[-2:]
    padded = F.pad(values.reshape(-1, 1, H, W), (WINDOW // 2,) * 4, mode="replicate")
    rows = reduce(torch.add, (padded[..., k : k + H, :] for k in range(WINDOW)))
    total = reduce(torch.add, (rows[..., k : k + W] for k in range(WINDOW)))
    return (total / WINDOW**2).reshape(values.shape)


def smooth(
    costs: Float[Tensor, "B V h w D"],
    weights: Float[Tensor, "B V h w"],
    edges: Float[Tensor, "B V 2 h w"],
) -> Lowest:
    """Find the plane of least smoothed cost.

    The costs are added up along rows and columns, both ways; a step between neighboring pixels
    costs less where the color changes (`edges`, to the left and above).
    """
    costs = costs * weights[..., None].clamp_min(LEAST_WEIGHT)
    penalty = LARGE_STEP / (1 + edges / EDGE)
    left, above = penalty[:, :, 0], penalty[:, :, 1]
    total = (
        _along(costs, left, 3)
        + _along(costs.flip(3), left.roll(-1, 3).flip(3), 3).flip(3)
        + _along(costs, above, 2)
        + _along(costs.flip(2), above.roll(-1, 2).flip(2), 2).flip(2)
    )
    return lowest_plane(total)


def lowest_plane(total: Float[Tensor, "B V h w D"]) -> Lowest:
    """Find the plane of least cost, between planes by the parabola through three."""
    planes = total.shape[-1]
    best = total.argmin(-1, keepdim=True)
    middle = total.gather(-1, best)
    before = total.gather(-1, (best - 1).clamp_min(0))
    after = total.gather(-1, (best + 1).clamp_max(planes - 1))
    bend = before + after - 2 * middle
    inside = (best > 0) & (best < planes - 1) & (bend > FLATTEST)
    shift = torch.where(inside, (before - after) / (2 * bend.clamp_min(FLATTEST)), 0)
    contrast = total.mean(-1) - middle[..., 0]
    return Lowest((best + shift.clamp(-0.5, 0.5))[..., 0], contrast)


def _along(
    costs: Float[Tensor, "B V h w D"], penalty: Float[Tensor, "B V h w"], dim: int
) -> Float[Tensor, "B V h w D"]:
    """Return each pixel's costs with what the path to it costs (Hirschmueller 2008, Eq. 13)."""
    pixels, penalties = costs.unbind(dim), penalty.unbind(dim)
    paths = [pixels[0]]
    far = pixels[0].new_full((*pixels[0].shape[:-1], 1), torch.inf)
    for cost, step in zip(pixels[1:], penalties[1:], strict=True):
        before = paths[-1]
        least = before.amin(-1, keepdim=True)
        nearer = torch.cat((before[..., 1:], far), dim=-1)
        farther = torch.cat((far, before[..., :-1]), dim=-1)
        step = torch.minimum(torch.minimum(nearer, farther) + SMALL_STEP, least + step[..., None])
        paths.append(cost + torch.minimum(before, step) - least)
    return torch.stack(paths, dim=dim)


def count_votes(
    inverse: Float[Tensor, "B V h w"],
    steps: Float[Tensor, "B V"],
    trust: Float[Tensor, "B V h w"],
    others: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
) -> Votes:
    """Ask other views about the point that each pixel sees.

    Args:
        inverse: depths.
        steps: between those that a view can tell apart.
        trust: in a view's depths, in [0, 1]: what its vote counts.
        others: the views that are asked; -1 for none.
        projections: into those.
    """
    chunk = max(1, PLACES // inverse.numel())
    few = zip(others.split(chunk, dim=2), projections.split(chunk, dim=2), strict=True)
    parts = [_votes_of(inverse, steps, trust, *asked) for asked in few]
    return Votes(*(torch.stack(counts).sum(0) for counts in zip(*parts, strict=True)))


def _votes_of(
    inverse: Float[Tensor, "B V h w"],
    steps: Float[Tensor, "B V"],
    trust: Float[Tensor, "B V h w"],
    others: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
) -> Votes:
    B, _, h, w = inverse.shape
    scene = torch.arange(B, device=others.device)[:, None, None]
    view = others.clamp_min(0)
    y, x = torch.meshgrid(
        torch.arange(h, device=others.device) + 0.5,
        torch.arange(w, device=others.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack((x, y, torch.ones_like(x))).to(inverse)
    flat = torch.einsum("bvkij,jyx->bvkiyx", projections[..., :3], pixels)
    moved = projections[..., 3, None, None] * inverse[:, :, None, None]
    x, y, z = (flat + moved).unbind(3)
    front = z.clamp_min(FRONT)
    x, y = x / front, y / front
    within = (z > FRONT) & (x > 0) & (x < w) & (y > 0) & (y < h)
    within &= (others >= 0)[..., None, None]
    column, row = x.clamp(0, w - 1).long(), y.clamp(0, h - 1).long()
    place = (scene[..., None, None], view[..., None, None], row, column)
    nearer = inverse[:, :, None] / front - inverse[place]
    half_step = steps[scene, view][..., None, None] / 2
    tolerance = torch.maximum(half_step, TOLERANCE * inverse[place])
    same = within & (nearer.abs() <= tolerance)
    through = within & (nearer > tolerance)
    weight = trust[place]
    return Votes((same * weight).sum(2), (through * weight).sum(2), within.to(weight).sum(2))
