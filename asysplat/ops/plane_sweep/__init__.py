"""Depth from posed photographs alone: a plane sweep over each view's neighbors (Collins 1996).

What is swept and how far follows from the cameras (`cameras.py`). Each pixel is compared with its
neighbors' at every plane (`match`), the costs are smoothed along the image's rows and columns as
in semi-global matching (`smooth`, Hirschmueller 2008), and what the views say of each other's
depths gives the confidence (`agreement.py`). A first sweep of images of half the size finds the
range in which the second places its planes: surfaces take a tenth of what cameras could see.
`match` and `smooth` are kernels in cpu/ and cuda/, `count_votes` is one in cpu/ alone.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.plane_sweep.agreement import CONTRADICTION, Depths, fill, other_views, votes
from asysplat.ops.plane_sweep.backends import choose, load
from asysplat.ops.plane_sweep.cameras import (
    Projections,
    choose_neighbors,
    inverse_depth_range,
    least_step,
    observed_range,
)
from asysplat.ops.plane_sweep.images import edges, gray, shrink
from asysplat.scene import Cameras, TensorRecord

PLANES = 48
NEIGHBORS = 4
SURE = 0.5  # by which the best plane's costs, of four paths, are less than the mean
AGREED = 0.5  # agreement of a depth that counts for the range of the second sweep


@dataclass(frozen=True)
class SweptDepth(TensorRecord):
    """What a plane sweep finds.

    Args:
        inverse_depth: 1 / depth along the camera's z axis, > 0; 0 where nothing is known.
        confidence: in [0, 1]; 0 where no neighbor sees the same.
        same: how many other views find the same, each counted as far as it is trusted.
        within: in how many other views it would be, seen or hidden.
    """

    inverse_depth: Float[Tensor, "*batch V h w"]
    confidence: Float[Tensor, "*batch V h w"]
    same: Float[Tensor, "*batch V h w"]
    within: Float[Tensor, "*batch V h w"]


def plane_sweep(
    images: Float[Tensor, "B V 3 H W"],
    cameras: Cameras,
    stride: int = 1,
    planes: int = PLANES,
    neighbors: int = NEIGHBORS,
    backend: str = "auto",
    ranges: Float[Tensor, "B V 2"] | None = None,
) -> SweptDepth:
    """Find the depth of every `stride` x `stride` block of pixels; h = H / stride, w = W / stride.

    The costs take 4 B V h w D bytes for D planes; a quarter of that was taken before, by those of
    the first sweep. Beside them "cpu" holds twice those of one view for each thread, "cuda" all of
    them once more, and "reference" several times, and some fifty maps [D, H, W] while it compares
    one view.

    Args:
        images: RGB in [0, 1].
        cameras: of the images, [B, V].
        stride: divides H and W; costs are compared at every pixel and averaged over blocks.
        planes: number of inverse depths, at least 4.
        neighbors: number of views that each is compared with, at most.
        backend: "reference" (torch, any device and float type), "cpu" or "cuda", or "auto", which
            is the fast one for the device, and "reference" for float64.
        ranges: least and greatest inverse depth of each view; the cameras decide for a view with
            0 and 0, and for all without it.

    Raises:
        InputError: sizes that do not go together, or an unknown backend.
    """
    _check(images, cameras, stride, planes, neighbors)
    backend = choose(backend, images)
    images = images if images.dtype == torch.float64 else images.float()
    poses, intrinsics = cameras.cam_to_world.to(images), cameras.intrinsics.to(images)
    return SweptDepth(
        *_sweep(images, intrinsics, poses, stride, planes, neighbors, backend, ranges=ranges)
    )


@torch.library.custom_op("asysplat::plane_sweep", mutates_args=())
def _sweep(
    images: Tensor,
    intrinsics: Tensor,
    cam_to_world: Tensor,
    stride: int,
    planes: int,
    neighbors: int,
    backend: str,
    ranges: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sweep: one operator for torch, so that devices without content know its shapes."""
    cameras = Cameras(intrinsics, cam_to_world, *images.shape[-2:])
    projections = Projections.between(cameras)
    chosen = choose_neighbors(cameras, projections, neighbors)
    seen = inverse_depth_range(cameras, projections, chosen)
    ranges = seen if ranges is None else torch.where(ranges[..., 1:] > 0, ranges.to(seen), seen)
    sweep = _Sweep(projections, chosen, least_step(cameras, chosen), planes, stride, backend)
    half = (max(1, side // (2 * stride)) * stride for side in images.shape[-2:])
    found, agreement = sweep.depths(shrink(images, *half), ranges, smoothings=1)
    ranges = _narrowed(ranges, found, agreement, planes * sweep.least_step)
    found, agreement = sweep.depths(images, ranges, smoothings=2)
    everyone = other_views(images.shape[1], images.shape[0], images.device)
    small = projections.into(everyone, *found.inverse.shape[-2:])
    others = votes(found, everyone, small, trust=agreement, backend=backend)
    agreement = agreement / (1 + CONTRADICTION * others.through)
    precision = found.precision()
    inverse = fill(found.inverse, agreement * precision)
    return inverse, agreement * (1 + precision) / 2, others.same, others.within


@_sweep.register_fake
def _(images, intrinsics, cam_to_world, stride, planes, neighbors, backend, ranges):
    shape = (*images.shape[:2], images.shape[-2] // stride, images.shape[-1] // stride)
    return tuple(images.new_empty(shape) for _ in range(4))


@dataclass(frozen=True)
class _Sweep:
    """What both sweeps have in common."""

    projections: Projections
    chosen: Int[Tensor, "B V K"]
    least_step: Float[Tensor, "B V"]
    planes: int
    stride: int
    backend: str

    def depths(
        self, images: Float[Tensor, "B V 3 H W"], ranges: Float[Tensor, "B V 2"], smoothings: int
    ) -> tuple[Depths, Float[Tensor, "B V h w"]]:
        """Return the depths of all views, and how far their neighbors agree with them.

        After the first smoothing a pixel's costs count as much as its neighbors agreed with it.
        """
        form = load(self.backend, images)
        height, width = images.shape[-2:]
        h, w = height // self.stride, width // self.stride
        projections = self.projections.into(self.chosen, height, width)
        costs = form.match(gray(images), self.chosen, projections, ranges, self.planes, self.stride)
        borders = edges(shrink(images, h, w))
        least, greatest = ranges[..., None, None, :].unbind(-1)
        plane = (greatest - least) / (self.planes - 1)
        step = torch.maximum(plane[..., 0, 0], self.least_step)
        small = self.projections.into(self.chosen, h, w)
        agreement = images.new_ones(*images.shape[:2], h, w)
        for _ in range(smoothings):
            lowest = form.smooth(costs, agreement, borders)
            found = Depths(least + lowest.plane * plane, step)
            agreement = votes(found, self.chosen, small, backend=self.backend).agreement()
        return found, agreement * (lowest.contrast / SURE).clamp(0, 1)


def _narrowed(
    ranges: Float[Tensor, "B V 2"],
    found: Depths,
    agreement: Float[Tensor, "B V h w"],
    shortest: Float[Tensor, "B V"],
) -> Float[Tensor, "B V 2"]:
    """Return the ranges of what neighbors agree on, within those given; few depths change none."""
    observed = observed_range(found.inverse.flatten(2), agreement.flatten(2) > AGREED)
    half_step = found.step / 2
    least = torch.maximum(ranges[..., 0], observed[..., 0] - half_step)
    greatest = torch.maximum(observed[..., 1] + half_step, least + shortest)
    narrowed = torch.stack((least, torch.minimum(ranges[..., 1], greatest)), dim=-1)
    return torch.where(observed[..., 1:] > 0, narrowed, ranges)


def _check(images: Tensor, cameras: Cameras, stride: int, planes: int, neighbors: int) -> None:
    expected = (*cameras.intrinsics.shape[:-2], 3, cameras.height, cameras.width)
    if images.ndim != 5 or tuple(images.shape) != expected:
        raise InputError(
            f"plane_sweep's images have shape {tuple(images.shape)}: expected {expected}, as the "
            "cameras say."
        )
    if stride < 1 or cameras.height % stride or cameras.width % stride:
        raise InputError(
            f"plane_sweep got stride={stride} for images of {cameras.height}x{cameras.width}: give "
            "a number that divides both."
        )
    if planes < 4 or neighbors < 1:
        raise InputError(
            f"plane_sweep got planes={planes} and neighbors={neighbors}: give at least 4 planes "
            "and one neighbor."
        )
