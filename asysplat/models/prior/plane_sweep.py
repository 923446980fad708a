"""Depth from posed images alone: a plane sweep over each view's neighbors (Collins 1996).

The cameras decide the neighbors and the range of depths (`projections.py`). The kernels of
`asysplat.ops.plane_sweep` compute the matching costs, aggregate them and check the views' depths
against each other, which gives the confidence; where it is low, planes of what is sure around go on
(`fill.py`). A first sweep at half the resolution narrows the range of the second: surfaces fill a
tenth of the range that the cameras allow.
"""

from functools import reduce

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor
from torch._subclasses.fake_tensor import is_fake

from asysplat.errors import InputError
from asysplat.kernels.dispatch import without_autocast
from asysplat.models.network import Network
from asysplat.models.prior.fill import color_edges, fill_unknown
from asysplat.models.prior.prior import DepthEstimate, Prior, count_votes, other_views
from asysplat.models.prior.projections import (
    PairwiseProjections,
    choose_neighbors,
    inverse_depth_range,
    observed_range,
    smallest_step,
)
from asysplat.ops.plane_sweep import Consistency, choose_backend, load_backend
from asysplat.scene import Cameras, Gaussians, Views, decode

PLANES = 64
NEIGHBORS = 4
LONGEST_SIDE = 128  # greatest side of the swept images in pixels: more than twice the planes
FULL_CONTRAST = 1.0  # contrast of a sure depth: mean minus least cost, summed over four paths
MIN_AGREEMENT = 0.5  # agreement above which a depth counts for the second sweep's range
CONTRADICTION = 2.0  # one contradicting view takes two thirds of the confidence
PIXEL_SPREAD = 0.18  # standard deviation in pixels: those of other views lie between
LUMA = (0.299, 0.587, 0.114)


class PlaneSweep(Network):
    """The Gaussians of a plane sweep alone, one for each pixel: nothing is trained.

    Swept images are shrunk to a size that suits the number of planes.

    Args:
        planes, neighbors: see `plane_sweep`.
        longest_side: greatest side of the swept images, in pixels.
    """

    def __init__(
        self, planes: int = PLANES, neighbors: int = NEIGHBORS, longest_side: int = LONGEST_SIDE
    ):
        super().__init__(patch=1)
        self.planes, self.neighbors, self.longest_side = planes, neighbors, longest_side

    def predict(self, views: Views) -> Gaussians:
        """Predict Gaussians [B, N] from views [B, V]; N = V H W.

        Colors and places have gradients of the images and of the poses; depths have none.
        """
        with without_autocast(views.images):
            return gaussians_of_estimate(self.sweep(views), views)

    @torch.no_grad()
    def sweep(self, views: Views) -> DepthEstimate:
        """Estimate the depths of the views, [B, V], shrunk to at most `longest_side` pixels."""
        height, width, factor = views.cameras.height, views.cameras.width, 1
        while max(height, width) > self.longest_side * factor:
            factor *= 2
        small = views.cameras.resized(*(max(1, side // factor) for side in (height, width)))

        def shrunk(view: int) -> Float[Tensor, "B 3 h w"]:
            image = decode(views.images[:, view])
            if views.masks is not None:  # what is masked out has no effect
                image = image.where(views.masks[:, view, None], 0.5)
            return shrink(image, small.height, small.width)

        # One by one: all views are not decoded at once.
        images = torch.stack([shrunk(view) for view in range(views.num_views)], dim=1)
        masks = views.surfaces((small.height, small.width))
        return plane_sweep(images, small, planes=self.planes, neighbors=self.neighbors, masks=masks)


def gaussians_of_estimate(estimate: DepthEstimate, views: Views) -> Gaussians:
    """Place a Gaussian [B, V H W] at the surface point of each pixel of views [B, V].

    They are drawn as they are: the views' own lie between each other.
    """
    size = views.cameras.height, views.cameras.width
    return Prior.from_estimate(estimate, views, size).gaussians(views, PIXEL_SPREAD)


def plane_sweep(
    images: Float[Tensor, "B V 3 H W"],
    cameras: Cameras,
    planes: int = PLANES,
    neighbors: int = NEIGHBORS,
    backend: str = "auto",
    masks: Bool[Tensor, "B V H W"] | None = None,
) -> DepthEstimate:
    """Estimate the depth of every pixel: [B, V, H, W].

    The cost volume takes 4 B V H W D bytes for D planes; the first sweep's, a quarter of that, is
    freed before. In addition "cpu" holds twice the volume of one view for each thread, "cuda" the
    whole volume once more, and "reference" several times, with some fifty maps [D, H, W] while it
    compares one view.

    Args:
        images: RGB in [0, 1].
        planes: number of inverse depths, at least 4.
        neighbors: most views that each view is compared with.
        backend: "reference" (torch, any device and float type), "cpu", "cuda", or "auto": the
            kernels of the device, and "reference" for float64.
        masks: False in pixels that have no confidence; None: in none.
    """
    _check(images, cameras, planes, neighbors)
    backend = choose_backend(backend, images)
    images = images if images.dtype == torch.float64 else images.float()
    poses, intrinsics = cameras.cam_to_world.to(images), cameras.intrinsics.to(images)
    inverse, confidence, *votes = _plane_sweep(
        images, intrinsics, poses, planes, neighbors, backend, masks
    )
    return DepthEstimate(inverse, confidence, Consistency(*votes))


@torch.library.custom_op("asysplat::plane_sweep", mutates_args=())
def _plane_sweep(
    images: Tensor,
    intrinsics: Tensor,
    cam_to_world: Tensor,
    planes: int,
    neighbors: int,
    backend: str,
    masks: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Sweep twice; one operator for torch, so that the meta device gets shapes without content."""
    cameras = Cameras(intrinsics, cam_to_world, *images.shape[-2:])
    projections = PairwiseProjections.from_cameras(cameras)
    chosen = choose_neighbors(cameras, projections, neighbors)
    shortest = smallest_step(cameras, chosen)
    ranges = inverse_depth_range(cameras, projections, chosen)
    kernels = load_backend(backend, images)

    def sweep(
        images: Float[Tensor, "B V 3 H W"],
        edges: Float[Tensor, "B V 2 H W"],
        valid: Float[Tensor, "B V H W"],
        ranges: Float[Tensor, "B V 2"],
        aggregations: int,
    ) -> tuple[Float[Tensor, "B V H W"], Float[Tensor, "B V"], Float[Tensor, "B V H W"]]:
        """Return the inverse depths, the steps between planes, and how far neighbors agree.

        From the second aggregation on, a pixel's costs have its agreement as weight.
        """
        height, width = images.shape[-2:]
        gray = (images * images.new_tensor(LUMA)[:, None, None]).sum(-3)
        into = projections.matrices(chosen, height, width)
        costs = kernels.cost_volume(gray, chosen, into, ranges, planes)
        first, last = ranges[..., None, None, :].unbind(-1)
        spacing = (last - first) / (planes - 1)
        steps = torch.maximum(spacing[..., 0, 0], shortest)
        agreement = valid
        for _ in range(aggregations):
            best = kernels.sgm(costs, agreement, edges)
            inverse = first + best.plane * spacing
            consistency = kernels.consistency(inverse, steps, valid, chosen, into)
            agree, contradict = consistency.agreeing, consistency.contradicting
            agreement = valid * (2 * agree / (agree + contradict + 1)).clamp_max(1)
        return inverse, steps, agreement * (best.contrast / FULL_CONTRAST).clamp(0, 1)

    valid = torch.ones_like(images[:, :, 0]) if masks is None else masks.to(images)
    half = [max(1, side // 2) for side in images.shape[-2:]]
    small = shrink(images, *half)
    smaller = small, color_edges(small), (shrink(valid, *half) == 1).to(valid)
    inverse, steps, agreement = sweep(*smaller, ranges, aggregations=1)
    # Narrow the ranges to the depths that neighbors agree on, unless these are few.
    observed = observed_range(inverse.flatten(2), agreement.flatten(2) > MIN_AGREEMENT)
    least = torch.maximum(ranges[..., 0], observed[..., 0] - steps / 2)
    greatest = torch.maximum(observed[..., 1] + steps / 2, least + planes * shortest)
    narrowed = torch.stack((least, torch.minimum(ranges[..., 1], greatest)), dim=-1)
    ranges = torch.where(observed[..., 1:] > 0, narrowed, ranges)
    edges = color_edges(images)
    inverse, steps, agreement = sweep(images, edges, valid, ranges, aggregations=2)
    others = other_views(images.shape[1], images.shape[0], images.device)
    into = projections.matrices(others, *images.shape[-2:])
    consistency = kernels.consistency(inverse, steps, agreement, others, into)
    agreement = agreement / (1 + CONTRADICTION * consistency.contradicting)
    squared = inverse**2  # how well a depth differs from the next plane's; 0 at infinity
    precision = squared / (squared + steps[..., None, None] ** 2).clamp_min(1e-30)
    inverse = fill_unknown(inverse, agreement * precision, edges, backend)
    confidence = agreement * (1 + precision) / 2
    return inverse, confidence, *count_votes(inverse, confidence, others, into, backend)


@_plane_sweep.register_fake
def _(images, intrinsics, cam_to_world, planes, neighbors, backend, masks):
    return tuple(torch.empty_like(images[:, :, 0]) for _ in range(6))


def _check(images: Tensor, cameras: Cameras, planes: int, neighbors: int) -> None:
    expected = (*cameras.intrinsics.shape[:-2], 3, cameras.height, cameras.width)
    if images.ndim != 5 or tuple(images.shape) != expected:
        raise InputError(
            f"plane_sweep's images have shape {tuple(images.shape)}: expected {expected}, the "
            "cameras' number and size."
        )
    if images.is_cpu and not is_fake(images):  # on a GPU it would wait for the device
        cameras.validate("plane_sweep's cameras")
    if planes < 4 or neighbors < 1:
        raise InputError(
            f"plane_sweep got planes={planes} and neighbors={neighbors}: give at least 4 planes "
            "and one neighbor."
        )


def shrink(
    images: Float[Tensor, "*more H W"], height: int, width: int
) -> Float[Tensor, "*more h w"]:
    """Resize images to `height` x `width` pixels by the means over areas.

    Sums of shifted maps where the sizes divide: torch's pooling takes several times as long there.
    """
    H, W = images.shape[-2:]
    if H % height or W % width:
        smaller = F.interpolate(images.reshape(-1, 1, H, W), (height, width), mode="area")
        return smaller.reshape(*images.shape[:-2], height, width)
    down, right = H // height, W // width
    if down == right == 1:
        return images
    rows = reduce(torch.add, (images[..., k::down, :] for k in range(down)))
    return reduce(torch.add, (rows[..., k::right] for k in range(right))) / (down * right)
