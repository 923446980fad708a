"""Exposures of photographs: gains with which they agree on the places that several of them show."""

import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.kernels.dispatch import to_float64
from asysplat.models.prior.prior import DepthEstimate
from asysplat.refinement.init import MIN_CONFIDENCE, depth_views, sweep
from asysplat.scene import Cameras, Views, decode

CLIPPED = 0.99  # least color that may have been brighter
NEAREST = 8  # other photographs that each is compared with
SAME_PLACE = 0.03  # relative difference of two depths of one place
DARKEST, BRIGHTEST = 0.04, 0.96  # colors that are compared: others may be clipped
MIN_PLACES = 30  # that two photographs must share
ROBUST = 0.05  # difference of log gains that halves the weight of a pair
REWEIGHTINGS = 5
MIN_SPREAD = 0.02  # least spread of a pair's log ratios: fewer differ by more than noise
UNCHANGED = 0.9  # share of the disagreement that gains must not leave, or they are none
PREDICTED_BY = 4  # inputs on whose exposure that of another photograph is based


@torch.no_grad()
def find_exposures(
    views: Views, estimate: DepthEstimate | None = None
) -> Float[Tensor, "V 3"] | None:
    """Estimate the log gains of photographs, of mean 0 in each channel.

    The places that two of them show come from the plane sweep, whose costs do not depend on
    exposure; the medians of their log ratios are the differences of log gains, and the gains fit
    those of all pairs (as in panoramas, Brown and Lowe 2007). None if they explain little of the
    disagreement, so that it is of the light, or if alphas say that the photographs are composed.
    An `estimate` is that of `sweep`.
    """
    if views.alphas is not None:
        return None
    pairs = [
        pair for pair in _compare(views, estimate or sweep(views)) if len(pair[1]) >= MIN_PLACES
    ]
    if not pairs:
        return None
    medians = torch.stack([ratios.median(0).values for _, ratios in pairs])
    spreads = torch.stack([_disagreement(r, m) for (_, r), m in zip(pairs, medians, strict=True)])
    sizes = spreads.new_tensor([len(ratios) for _, ratios in pairs])
    first, second = torch.tensor([pair for pair, _ in pairs], device=medians.device).mT
    gains = _fit(first, second, medians, sizes.sqrt() / (spreads + MIN_SPREAD), views.num_views)
    differences = gains[first] - gains[second]
    before = sum(_disagreement(r, torch.zeros(3).to(r)) for _, r in pairs)
    after = sum(_disagreement(r, d) for (_, r), d in zip(pairs, differences, strict=True))
    return gains if after < UNCHANGED * before else None


def even_exposures(views: Views, exposures: Float[Tensor, "V 3"]) -> Views:
    """Return photographs as if all had the mean exposure; what becomes brighter than 1 is white.

    Pixels that are clipped in a brighter photograph are masked out: their colors are unknown.
    """
    darker = views.with_images(lambda view, one: expose(one.images, -exposures[[view]]).clamp(0, 1))
    brighter = (exposures > 0)[..., None, None]
    clipped = [(decode(i) >= CLIPPED) & b for i, b in zip(views.images, brighter, strict=True)]
    return darker.without(torch.stack([channels.any(0) for channels in clipped]))


def expose(
    images: Float[Tensor, "V 3 H W"], exposures: Float[Tensor, "V 3"]
) -> Float[Tensor, "V 3 H W"]:
    """Apply log gains to images."""
    return images * exposures.exp()[..., None, None]


def predict_exposures(
    exposures: Float[Tensor, "V 3"], inputs: Cameras, cameras: Cameras
) -> Float[Tensor, "T 3"]:
    """Predict the log gains of other photographs by those of the nearest inputs.

    They are multiplied by how much of the inputs' own gains their neighbors explain: all where a
    camera adapted slowly, nothing where exposures jump.
    """
    apart = inputs.distances(inputs).fill_diagonal_(math.inf)
    error = (exposures - _nearest_mean(exposures, apart)).square().sum()
    explained = (1 - error / exposures.square().sum().clamp_min(1e-12)).clamp_min(0)
    return explained * _nearest_mean(exposures, cameras.distances(inputs))


def _compare(
    views: Views, estimate: DepthEstimate
) -> Iterator[tuple[tuple[int, int], Float[Tensor, "places 3"]]]:
    """Yield pairs of photographs, and the log ratios of their colors at places that both show."""
    swept = depth_views(views)
    inverse, known = estimate.inverse_depth[0], estimate.confidence[0] > MIN_CONFIDENCE
    known &= inverse > 0
    small, rows = views.resized(*inverse.shape[-2:]), {view: row for row, view in enumerate(swept)}
    images, cameras = decode(small.images), small.cameras
    if small.masks is not None:
        images = images * small.masks[:, None]  # too dark to compare
    poses, directions = cameras.cam_to_world, cameras.pixel_directions()
    near = cameras.distances(cameras.select(swept)).argsort(-1)[:, : NEAREST + 1]
    for view, rows_near in enumerate(near.tolist()):
        for row in rows_near:
            other, at = swept[row], known[row]
            if other == view:
                continue
            local = directions[other][at] / inverse[row][at][:, None]
            points = local @ poses[other, :3, :3].mT + poses[other, :3, 3]
            pixels, depth, inside = (part[0] for part in cameras.select([view]).project(points))
            if view in rows:
                maps = torch.stack((inverse[rows[view]], known[rows[view]].to(inverse)))
                found, sure = _sample(maps, pixels, "nearest").unbind(-1)
                inside &= (sure > 0) & ((found * depth - 1).abs() < SAME_PLACE)
            colors = torch.stack((_sample(images[view], pixels), images[other][:, at].mT))
            inside &= ((colors > DARKEST) & (colors < BRIGHTEST)).all(-1).all(0)
            ratios = colors[:, inside].log()
            yield (view, other), ratios[0] - ratios[1]


def _sample(
    maps: Float[Tensor, "C H W"], pixels: Float[Tensor, "N 2"], mode: str = "bilinear"
) -> Float[Tensor, "N C"]:
    size = pixels.new_tensor([maps.shape[-1], maps.shape[-2]])
    places = (pixels / size * 2 - 1).to(maps)[None, None]
    sampled = F.grid_sample(maps[None], places, mode, "border", align_corners=False)
    return sampled[0, :, 0].mT


def _nearest_mean(
    exposures: Float[Tensor, "V 3"], distances: Float[Tensor, "T V"]
) -> Float[Tensor, "T 3"]:
    """Average the log gains of the nearest inputs, weighted by inverse square distance."""
    near = distances.topk(min(PREDICTED_BY, len(exposures)), largest=False)
    weights = 1 / near.values.clamp(1e-6, 1e6).square()
    return (exposures[near.indices] * weights[..., None]).sum(1) / weights.sum(1, keepdim=True)


def _disagreement(
    ratios: Float[Tensor, "places 3"], gains: Float[Tensor, "3"]
) -> Float[Tensor, ""]:
    return (ratios - gains).abs().median(0).values.mean()


def _fit(
    first: Int[Tensor, "pairs"],
    second: Int[Tensor, "pairs"],
    differences: Float[Tensor, "pairs 3"],
    weights: Float[Tensor, "pairs"],
    count: int,
) -> Float[Tensor, "V 3"]:
    """Fit `count` numbers of mean 0 to weighted differences of two, by reweighted least squares."""
    difference, prior = to_float64(differences), 1e-3 * torch.eye(count, dtype=torch.float64)
    signs = torch.zeros(len(first), count, dtype=torch.float64)
    rows = torch.arange(len(first))
    signs[rows, first.cpu()], signs[rows, second.cpu()] = 1, -1
    scale = weight = to_float64(weights / weights.mean()).cpu()[:, None]
    difference = difference.cpu()
    for _ in range(REWEIGHTINGS):
        equations = torch.cat((signs * weight, prior))
        wanted = torch.cat((difference * weight, prior.new_zeros(count, 3)))
        gains = torch.linalg.lstsq(equations, wanted).solution
        error = (signs @ gains - difference).abs().mean(1, keepdim=True)
        weight = scale / (1 + error / ROBUST)
    return (gains - gains.mean(0)).to(differences)
