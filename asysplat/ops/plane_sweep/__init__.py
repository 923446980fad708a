"""Depth from posed photographs alone: a plane sweep over each view's neighbours (Collins 1996).

What is swept and how far follows from the cameras (`cameras.py`). Each pixel is compared with its
neighbours' at every plane (`match`), the costs are smoothed along the image's rows and columns as
in semi-global matching (`smooth`, Hirschmueller 2008), and what the views say of each other's
depths gives the confidence (`agreement.py`). `match` and `smooth` are kernels in cpu/ and cuda/.
"""

from dataclasses import dataclass
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.dispatch import FAST, check_fast_backend, fast_backend, pick_backend
from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.agreement import Depths, compare, fill
from asysplat.ops.plane_sweep.cameras import (
    choose_neighbours,
    inverse_depth_range,
    relative_projections,
)
from asysplat.scene import Cameras, TensorRecord

PLANES = 64
NEIGHBOURS = 4
SURE = 0.5  # by which the best plane's costs, of four paths, are less than the mean
LUMA = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class SweptDepth(TensorRecord):
    """What a plane sweep finds.

    Args:
        inverse_depth: 1 / depth along the camera's z axis, > 0; 0 where nothing is known.
        confidence: in [0, 1]; 0 where no neighbour sees the same.
    """

    inverse_depth: Float[Tensor, "*batch V h w"]
    confidence: Float[Tensor, "*batch V h w"]


def plane_sweep(
    images: Float[Tensor, "B V 3 H W"],
    cameras: Cameras,
    stride: int = 1,
    planes: int = PLANES,
    neighbours: int = NEIGHBOURS,
    backend: str = "auto",
    ranges: Float[Tensor, "B V 2"] | None = None,
) -> SweptDepth:
    """Find the depth of every `stride` x `stride` block of pixels; h = H / stride, w = W / stride.

    The costs take 4 B V h w D bytes for D planes. Beside them "cpu" holds twice those of one view
    for each thread, "cuda" all of them once more, and "reference" several times, and some fifty
    maps [D, H, W] while it compares one view.

    Args:
        images: RGB in [0, 1].
        cameras: of the images, [B, V].
        stride: divides H and W; costs are compared at every pixel and averaged over blocks.
        planes: number of inverse depths, at least 4.
        neighbours: number of views that each is compared with, at most.
        backend: "reference" (torch, any device and float type), "cpu" or "cuda", or "auto", which
            is the fast one for the device, and "reference" for float64.
        ranges: least and greatest inverse depth of each view; the cameras decide for a view with
            0 and 0, and for all without it.

    Raises:
        InputError: sizes that do not go together, or an unknown backend.
    """
    _check(images, cameras, stride, planes, neighbours)
    backend = fast_backend(images, "reference") if backend == "auto" else backend
    _check_backend(backend, images)
    images = images if images.dtype == torch.float64 else images.float()
    poses, intrinsics = cameras.cam_to_world.to(images), cameras.intrinsics.to(images)
    return SweptDepth(
        *_sweep(images, intrinsics, poses, stride, planes, neighbours, backend, ranges=ranges)
    )


@torch.library.custom_op("asysplat::plane_sweep", mutates_args=())
def _sweep(
    images: Tensor,
    intrinsics: Tensor,
    cam_to_world: Tensor,
    stride: int,
    planes: int,
    neighbours: int,
    backend: str,
    ranges: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Sweep: one operator for torch, so that devices without content know its shapes."""
    form = _load(backend)
    cameras = Cameras(intrinsics, cam_to_world, *images.shape[-2:])
    small = cameras.resized(cameras.height // stride, cameras.width // stride)
    chosen = choose_neighbours(cameras, neighbours)
    seen = inverse_depth_range(cameras, chosen)
    ranges = seen if ranges is None else torch.where(ranges[..., 1:] > 0, ranges.to(seen), seen)
    projections = relative_projections(cameras, chosen)
    grey = (images * images.new_tensor(LUMA)[:, None, None]).sum(2)
    costs = form.match(grey, chosen, projections, ranges, planes, stride)
    edges = _edges(images, stride)
    agreement = images.new_ones(*images.shape[:2], small.height, small.width)
    for _ in range(2):  # once with all costs, once with those of what the neighbours agree on
        lowest = form.smooth(costs, agreement, edges)
        found = Depths.at_planes(lowest.plane, ranges, planes)
        agreement = compare(found, small, chosen)
    agreement = agreement * (lowest.contrast / SURE).clamp(0, 1)
    precision = found.precision()
    return fill(found.inverse, agreement * precision), agreement * (1 + precision) / 2


@_sweep.register_fake
def _(images, intrinsics, cam_to_world, stride, planes, neighbours, backend, ranges):
    shape = (*images.shape[:2], images.shape[-2] // stride, images.shape[-1] // stride)
    return images.new_empty(shape), images.new_empty(shape)


def _edges(images: Tensor, stride: int) -> Float[Tensor, "B V 2 h w"]:
    """Return the mean absolute colour difference to the block on the left, and to that above."""
    blocks = torch.nn.functional.avg_pool2d(images.flatten(0, 1), stride).unflatten(
        0, images.shape[:2]
    )
    left = torch.zeros_like(blocks[:, :, 0])
    above = torch.zeros_like(left)
    left[..., 1:] = blocks.diff(dim=-1).abs().mean(2)
    above[..., 1:, :] = blocks.diff(dim=-2).abs().mean(2)
    return torch.stack((left, above), dim=2)


def _check_backend(backend: str, images: Tensor) -> None:
    pick_backend("plane_sweep", dict.fromkeys(("auto", "reference", *FAST)), backend)
    if backend != "reference":
        check_fast_backend("plane_sweep", backend, images)


def _load(backend: str) -> ModuleType:
    if backend == "cpu":
        from asysplat.ops.plane_sweep import cpu

        return cpu
    if backend == "cuda":
        from asysplat.ops.plane_sweep import cuda

        return cuda
    return reference


def _check(images: Tensor, cameras: Cameras, stride: int, planes: int, neighbours: int) -> None:
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
    if planes < 4 or neighbours < 1:
        raise InputError(
            f"plane_sweep got planes={planes} and neighbours={neighbours}: give at least 4 planes "
            "and one neighbour."
        )
