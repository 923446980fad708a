"""Render a few views at a time, in the memory of these views."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.kernels.dispatch import without_autocast
from asysplat.rendering.interface import RenderOutputs, RenderSettings
from asysplat.scene import Cameras, Gaussians

Draw = Callable[..., RenderOutputs]  # a backend's `draw`
PER_VIEW = ("cam_to_world", "intrinsics")
NAMES = (*(field.name for field in dataclasses.fields(Gaussians)), *PER_VIEW)
NOT_SUMMED = ("tile_size",)  # statistics that are the same for all chunks


def draw_in_chunks(
    draw: Draw,
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Tensor | None,
    views_at_once: int | None,
    centers: Tensor | None = None,
) -> RenderOutputs:
    """Draw all views at once, or `views_at_once` of every scene at a time.

    If memory is too small, try half as many, with a warning. With `centers`, which receives the
    gradients of the splats' centers, all are drawn at once.
    """
    if views_at_once is not None and views_at_once < 1:
        raise InputError(f"render's views_at_once is {views_at_once}: give at least 1, or None.")
    if centers is not None:
        if views_at_once is not None:
            raise InputError(
                f"render's views_at_once is {views_at_once} and projections=True: leave out one."
            )
        return draw(gaussians, cameras, settings, masks, centers)
    num_views = min(views_at_once or cameras.num_views, cameras.num_views)

    def draw_views(
        views: slice, inputs: Sequence[Tensor]
    ) -> tuple[list[Tensor | None], dict[str, int]]:
        """Draw `views` from their inputs; return images as [B, views, ...], and statistics."""
        *fields, poses, intrinsics = inputs
        chunk_cameras = Cameras(intrinsics, poses, cameras.height, cameras.width)
        chunk_masks = None if masks is None else masks[:, views]
        out = draw(Gaussians(*fields), chunk_cameras, settings, chunk_masks)
        images = (out.image, out.alpha, out.transmittance, out.depth, out.depth_origin)
        shape = poses.shape[:2]
        return [None if image is None else image.unflatten(0, shape) for image in images], out.stats

    while True:
        try:
            if num_views == cameras.num_views:
                return draw(gaussians, cameras, settings, masks)
            slices = [slice(i, i + num_views) for i in range(0, cameras.num_views, num_views)]
            stats: dict[str, int] = {}
            fields = [getattr(gaussians, name) for name in NAMES if name not in PER_VIEW]
            poses = (cameras.cam_to_world, cameras.intrinsics)
            *images, origins = _Deferred.apply(draw_views, slices, stats, *fields, *poses)
            return RenderOutputs(*images, stats, origins)
        except (torch.OutOfMemoryError, MemoryError) as error:
            if num_views <= 1:
                raise
            num_views = -(-num_views // 2)
            warnings.warn(
                f"render: memory does not hold so many views at once ({error}); drawing "
                f"{num_views} at a time, and again in the backward pass "
                f"(views_at_once={num_views}).",
                stacklevel=3,
            )


class _Deferred(torch.autograd.Function):
    """Saves only the inputs; the backward pass draws each chunk again, with a graph."""

    @staticmethod
    def forward(ctx, draw_views, slices, stats, *tensors):
        ctx.draw_views, ctx.slices = draw_views, slices
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        parts = []
        for views in slices:
            images, chunk_stats = draw_views(views, _select(tensors, views))
            parts.append(images)
            for name, count in chunk_stats.items():
                stats[name] = count + (0 if name in NOT_SUMMED else stats.get(name, 0))
        return tuple(
            None if images[0] is None else torch.cat(images, 1).flatten(0, 1)
            for images in zip(*parts, strict=True)
        )

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        shape, needed = ctx.saved_tensors[-1].shape[:2], ctx.needs_input_grad[3:]
        totals = [
            torch.zeros_like(tensor) if need else None
            for tensor, need in zip(ctx.saved_tensors, needed, strict=True)
        ]
        for views in ctx.slices:
            selected = zip(_select(ctx.saved_tensors, views), needed, strict=True)
            inputs = [tensor.detach().requires_grad_(need) for tensor, need in selected]
            with torch.enable_grad(), without_autocast(inputs[0]):
                images, _ = ctx.draw_views(views, inputs)
            outputs = [
                (image, grad.unflatten(0, shape)[:, views])
                for image, grad in zip(images, grads, strict=True)
                if grad is not None and image is not None and image.requires_grad
            ]
            drawn, drawn_grads = map(list, zip(*outputs, strict=True))
            torch.autograd.backward(drawn, drawn_grads)
            for name, total, tensor in zip(NAMES, totals, inputs, strict=True):
                if total is not None and tensor.grad is not None:
                    (total[:, views] if name in PER_VIEW else total).add_(tensor.grad)
        return (None, None, None, *totals)


def _select(tensors: Sequence[Tensor], views: slice) -> list[Tensor]:
    *fields, poses, intrinsics = tensors
    return [*fields, poses[:, views], intrinsics[:, views]]
