"""The operators of the plane sweep in torch, for any device and float type."""

from functools import reduce
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

WINDOW = 5  # pixels along a side of the compared patches
BEST = 2  # number of neighbors that count at each plane: others may not see the point
UNMATCHED = 0.8  # greatest cost, for unrelated patches and for points that no neighbor sees
SECOND = 0.15  # greatest excess of the second best neighbor's cost, as it may not see the point
NOISE = 3e-6  # variance of noise, added to each patch's: about twice that of rounding to 8 bits
SMALL_STEP = 0.1  # SGM's penalty for one plane more or less than the pixel before
LARGE_STEP = 1.0  # SGM's penalty for more than one plane, where the color does not change
EDGE = 0.05  # color difference to the pixel before that halves LARGE_STEP
MIN_WEIGHT = 0.05  # smallest weight of a pixel's own costs in SGM
MIN_BEND = 1e-9  # smallest curvature of a parabola whose minimum is computed
TOLERANCE = 0.01  # relative difference up to which two inverse depths agree
PIXELS_AT_ONCE = 2**20  # pixels whose consistency is checked at a time
FRONT = 1e-6  # smallest depth in another view that is in front of it, over the depth in this view
SPREAD_ROUNDS = 2  # rows, then columns: a path turns three times at most
VECTOR = 16  # planes that the CPU kernel computes at once: its LANES, whose import needs Numba


class BestPlane(NamedTuple):
    """The plane of least cost at each pixel."""

    plane: Float[Tensor, "B V h w"]  # index of the plane, with a fraction
    contrast: Float[Tensor, "B V h w"]  # mean cost over all planes minus the least cost


class Consistency(NamedTuple):
    """The numbers of other views that confirm or contradict a depth, each weighted by its trust."""

    agreeing: Float[Tensor, "B V h w"]  # that have the same depth at the pixel's point
    contradicting: Float[Tensor, "B V h w"]  # that see through the point, to a surface behind it
    occluding: Float[Tensor, "B V h w"]  # that see a surface in front of the point
    containing: Float[Tensor, "B V h w"]  # whose image contains the point, each counted as 1


class CostInputs(NamedTuple):
    """The inputs of the cost volume's kernels for the n views of all scenes; or NumPy arrays."""

    images: Tensor  # [n, H, W], each minus its mean
    padded: Tensor  # [n, H + 1, W + 1], with the last row and column repeated
    neighbors: Tensor  # [n, K] indices of neighboring views among all n; -1 for none
    projections: Tensor  # [n, K, 3, 4]
    inverse: Tensor  # [n, planes rounded up to whole vectors] inverse depths


def cost_volume(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
) -> Float[Tensor, "B V H W D"]:
    """Compute the cost of matching each pixel with neighboring views at every plane.

    A neighbor's cost is 1 - the zero-mean normalized cross-correlation of patches, which does not
    depend on exposure. The result, in [0, UNMATCHED], is the mean over the two best neighbors whose
    images contain the point. The second best's cost counts as at most SECOND above the best's, so
    that a neighbor that does not see the point hardly counts.

    Args:
        images: gray images.
        neighbors: indices of neighboring views in the same scene; -1 for none.
        projections: see `matrices` in asysplat/models/prior/projections.py.
        ranges: inverse depths of the first and of the last plane.
        planes: number of planes, at least 2, at equal steps of inverse depth.
    """
    B, V, H, W = images.shape
    # The mean's square would hide the small variances of an image.
    images = images - images.mean((-2, -1), keepdim=True)
    costs = images.new_empty(B, V, H, W, planes)
    pixels = _pixel_centers(H, W, images)
    for b in range(B):
        for v in range(V):
            first, last = ranges[b, v]
            steps = torch.arange(planes, device=ranges.device).to(ranges)
            inverse = first + steps * ((last - first) / (planes - 1))
            pairs = zip(neighbors[b, v].tolist(), projections[b, v], strict=True)
            matched = [
                _compare(images[b, v], images[b, neighbor], matrix, pixels, inverse)
                for neighbor, matrix in pairs
                if neighbor >= 0
            ]
            unseen = images.new_full((planes, H, W), torch.inf)
            while len(matched) < BEST:
                matched.append(unseen)
            first, second = torch.stack(matched).sort(dim=0).values[:BEST]
            first = first.clamp_max(UNMATCHED)
            second = torch.minimum(second, (first + SECOND).clamp_max(UNMATCHED))
            costs[b, v] = ((first + second) / 2).permute(1, 2, 0)
    return costs


def _compare(
    image: Float[Tensor, "H W"],
    neighbor: Float[Tensor, "H W"],
    matrix: Float[Tensor, "3 4"],
    pixels: Float[Tensor, "3 H W"],
    inverse: Float[Tensor, "D"],
) -> Float[Tensor, "D H W"]:
    """Return the cost of one neighbor at every plane; infinite for points outside its image."""
    H, W = image.shape
    flat = torch.einsum("ij,jyx->iyx", matrix[:, :3], pixels)
    points = flat + inverse[:, None, None, None] * matrix[:, 3, None, None]
    x, y, z = points.unbind(1)
    front = z.clamp_min(FRONT)
    x, y = x / front, y / front
    visible = (z > FRONT) & (x > 0) & (x < W) & (y > 0) & (y < H)
    places = torch.stack((x / W, y / H), dim=-1).clamp(-1, 2) * 2 - 1
    warped = F.grid_sample(
        neighbor.expand(len(places), 1, H, W), places, padding_mode="border", align_corners=False
    )[:, 0]
    mean, other_mean = patch_mean(image), patch_mean(warped)
    both = patch_mean(image * warped) - mean * other_mean
    variance = patch_mean(image**2) - mean**2
    other_variance = patch_mean(warped**2) - other_mean**2
    norm = (variance.clamp_min(0) + NOISE) * (other_variance.clamp_min(0) + NOISE)
    return torch.where(visible, 1 - both / norm.sqrt(), torch.inf)


def patch_mean(values: Float[Tensor, "*more H W"]) -> Float[Tensor, "*more H W"]:
    """Return the mean of the patch around each pixel; an image's border is repeated beyond it."""
    H, W = values.shape[-2:]
    padded = F.pad(values.reshape(-1, 1, H, W), (WINDOW // 2,) * 4, mode="replicate")
    rows = reduce(torch.add, (padded[..., k : k + H, :] for k in range(WINDOW)))
    total = reduce(torch.add, (rows[..., k : k + W] for k in range(WINDOW)))
    return (total / WINDOW**2).reshape(values.shape)


def sgm(
    costs: Float[Tensor, "B V h w D"],
    weights: Float[Tensor, "B V h w"],
    edges: Float[Tensor, "B V 2 h w"],
) -> BestPlane:
    """Aggregate the costs along rows and columns, both ways, and find the plane of least cost.

    A change of plane between adjacent pixels costs less where the color changes: `edges` has the
    color differences to the pixel on the left, and to the pixel above. The `weights` of the pixels'
    costs are in [0, 1].
    """
    costs = costs * weights[..., None].clamp_min(MIN_WEIGHT)
    penalty = LARGE_STEP / (1 + edges / EDGE)
    left, above = penalty[:, :, 0], penalty[:, :, 1]
    total = (
        _aggregate(costs, left, 3)
        + _aggregate(costs.flip(3), left.roll(-1, 3).flip(3), 3).flip(3)
        + _aggregate(costs, above, 2)
        + _aggregate(costs.flip(2), above.roll(-1, 2).flip(2), 2).flip(2)
    )
    return find_best_plane(total)


def find_best_plane(total: Float[Tensor, "B V h w D"]) -> BestPlane:
    """Find the plane of least cost, refined by the parabola through it and the adjacent planes."""
    planes = total.shape[-1]
    best = total.argmin(-1, keepdim=True)
    middle = total.gather(-1, best)
    before = total.gather(-1, (best - 1).clamp_min(0))
    after = total.gather(-1, (best + 1).clamp_max(planes - 1))
    bend = before + after - 2 * middle
    inside = (best > 0) & (best < planes - 1) & (bend > MIN_BEND)
    shift = torch.where(inside, (before - after) / (2 * bend.clamp_min(MIN_BEND)), 0)
    contrast = total.mean(-1) - middle[..., 0]
    return BestPlane((best + shift.clamp(-0.5, 0.5))[..., 0], contrast)


def _aggregate(
    costs: Float[Tensor, "B V h w D"], penalty: Float[Tensor, "B V h w"], dim: int
) -> Float[Tensor, "B V h w D"]:
    """Return the costs of the paths along `dim` to each pixel (Hirschmueller 2008, Eq. 13)."""
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


def spread(
    values: Float[Tensor, "B V h w C"], keep: Float[Tensor, "B V 2 h w"]
) -> Float[Tensor, "B V h w C"]:
    """Sum the values around each pixel, along rows, then along columns, SPREAD_ROUNDS times.

    A value counts as much as the product of `keep`, in [0, 1], along its path: the factors from the
    pixel on the left, and from the pixel above.
    """
    for _ in range(SPREAD_ROUNDS):
        for factors, dim in zip(keep[..., None].unbind(2), (3, 2), strict=True):
            values = _spread_along(values, factors, dim)
    return values


def _spread_along(
    values: Float[Tensor, "B V h w C"], factors: Float[Tensor, "B V h w 1"], dim: int
) -> Float[Tensor, "B V h w C"]:
    pixels, factors = values.unbind(dim), factors.unbind(dim)
    before, behind = [torch.zeros_like(pixels[0])], [torch.zeros_like(pixels[0])]
    for pixel, factor in zip(pixels[:-1], factors[1:], strict=True):
        before.append((before[-1] + pixel) * factor)
    for pixel, factor in zip(pixels[:0:-1], factors[:0:-1], strict=True):
        behind.append((behind[-1] + pixel) * factor)
    return values + torch.stack(before, dim) + torch.stack(behind[::-1], dim)


def consistency(
    inverse: Float[Tensor, "B V h w"],
    steps: Float[Tensor, "B V"],
    trust: Float[Tensor, "B V h w"],
    others: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    tolerance: float = TOLERANCE,
) -> Consistency:
    """Compare the inverse depth of each pixel with those of other views at the same point.

    A view that sees a surface in front of the point neither confirms nor contradicts it.

    Args:
        steps: smallest difference of inverse depths that each view can distinguish.
        trust: weight of each depth, in [0, 1].
        others, projections: see `neighbors` and `projections` of `cost_volume`.
        tolerance: relative difference up to which two inverse depths agree; they also agree up to
            half a step.
    """
    B, _, h, w = inverse.shape
    scene = torch.arange(B, device=others.device)[:, None, None]
    pixels = _pixel_centers(h, w, inverse)

    def count(others: Tensor, projections: Tensor) -> Consistency:
        view = others.clamp_min(0)
        flat = torch.einsum("bvkij,jyx->bvkiyx", projections[..., :3], pixels)
        shift = projections[..., 3, None, None] * inverse[:, :, None, None]
        x, y, z = (flat + shift).unbind(3)
        front = z.clamp_min(FRONT)
        x, y = x / front, y / front
        inside = (z > FRONT) & (x > 0) & (x < w) & (y > 0) & (y < h)
        inside &= (others >= 0)[..., None, None]
        column, row = x.clamp(0, w - 1).long(), y.clamp(0, h - 1).long()
        place = (scene[..., None, None], view[..., None, None], row, column)
        nearer = inverse[:, :, None] / front - inverse[place]
        half_step = steps[scene, view][..., None, None] / 2
        limit = torch.maximum(half_step, tolerance * inverse[place])
        agree = inside & (nearer.abs() <= limit)
        contradict, occlude = inside & (nearer > limit), inside & (nearer < -limit)
        weight = trust[place]
        counts = (agree * weight, contradict * weight, occlude * weight, inside.to(weight))
        return Consistency(*(values.sum(2) for values in counts))

    chunk = max(1, PIXELS_AT_ONCE // inverse.numel())
    chunks = zip(others.split(chunk, dim=2), projections.split(chunk, dim=2), strict=True)
    parts = [count(*part) for part in chunks]
    return Consistency(*(torch.stack(counts).sum(0) for counts in zip(*parts, strict=True)))


def _pixel_centers(height: int, width: int, like: Tensor) -> Float[Tensor, "3 H W"]:
    """Return each pixel center's homogeneous coordinates x, y and 1."""
    y, x = torch.meshgrid(
        torch.arange(height, device=like.device) + 0.5,
        torch.arange(width, device=like.device) + 0.5,
        indexing="ij",
    )
    return torch.stack((x, y, torch.ones_like(x))).to(like)


def prepare_inputs(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
) -> CostInputs:
    """Convert the inputs of `cost_volume` to those of its kernels."""
    device = images.device
    # The mean's square would hide the small variances of an image.
    flat = (images - images.mean((-1, -2), keepdim=True)).flatten(0, 1)
    first = torch.arange(len(images), device=device)[:, None, None] * images.shape[1]
    steps = (ranges[..., 1:] - ranges[..., :1]) / (planes - 1)
    indices = torch.arange(-(-planes // VECTOR) * VECTOR, device=device)
    return CostInputs(
        images=flat.contiguous(),
        padded=F.pad(flat[:, None], (0, 1, 0, 1), mode="replicate")[:, 0].contiguous(),
        neighbors=torch.where(neighbors >= 0, neighbors + first, -1).flatten(0, 1).contiguous(),
        projections=projections.flatten(0, 1).contiguous(),
        inverse=(ranges[..., :1] + indices * steps).flatten(0, 1),
    )
