"""Render a few views at a time, in the memory that these take."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.rendering.interface import RenderOutputs, RenderSettings
from asysplat.scene import Cameras, Gaussians

Draw = Callable[[Gaussians, Cameras, RenderSettings, Tensor | None], RenderOutputs]
PER_VIEW = ("cam_to_world", "intrinsics")
NAMES = (*(field.name for field in dataclasses.fields(Gaussians)), *PER_VIEW)
SAME_IN_ALL = ("tile_size",)  # statistics that do not add up


def draw_in_chunks(
    draw: Draw,
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Tensor | None,
    views_at_once: int | None,
) -> RenderOutputs:
    """Draw all views at once, or `views_at_once` of every scene at a time.

    Where memory does not hold that many, half as many are tried, and a warning says so.

    Raises:
        InputError: views_at_once below 1.
    """
    if views_at_once is not None and views_at_once < 1:
        raise InputError(f"render's views_at_once is {views_at_once}: give at least 1, or None.")
    together = min(views_at_once or cameras.num_views, cameras.num_views)
    while True:
        try:
            return _draw(draw, gaussians, cameras, settings, masks, together)
        except (torch.OutOfMemoryError, MemoryError) as error:
            if together <= 1:
                raise
            together = -(-together // 2)
            warnings.warn(
                f"render: memory does not hold so many views at once ({error}); drawing {together} "
                f"at a time, and again in the backward pass (views_at_once={together}).",
                stacklevel=3,
            )


def _draw(
    draw: Draw,
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Tensor | None,
    views_at_once: int,
) -> RenderOutputs:
    if views_at_once >= cameras.num_views:
        return draw(gaussians, cameras, settings, masks)
    stats: dict[str, int] = {}
    job = _Job(draw, settings, masks, cameras.height, cameras.width, views_at_once, stats)
    fields = [getattr(gaussians, name) for name in NAMES if name not in PER_VIEW]
    *images, origins = _Deferred.apply(job, *fields, cameras.cam_to_world, cameras.intrinsics)
    return RenderOutputs(*images, stats, origins)


@dataclasses.dataclass(frozen=True)
class _Job:
    """How to draw some of the views; `stats` is filled on the way."""

    draw: Draw
    settings: RenderSettings
    masks: Tensor | None
    height: int
    width: int
    views_at_once: int
    stats: dict[str, int]

    def chunks(self, num_views: int) -> list[slice]:
        """Divide the views."""
        starts = range(0, num_views, self.views_at_once)
        return [slice(start, start + self.views_at_once) for start in starts]

    def part(self, tensors: Sequence[Tensor], views: slice) -> list[Tensor]:
        """Take what belongs to some views from all tensors."""
        *fields, poses, intrinsics = tensors
        return [*fields, poses[:, views], intrinsics[:, views]]

    def draw_part(
        self, part: Sequence[Tensor], views: slice
    ) -> tuple[list[Tensor | None], dict[str, int]]:
        """Draw the `part` of `views`; return images as [B, views, ...], and statistics."""
        *fields, poses, intrinsics = part
        cameras = Cameras(intrinsics, poses, self.height, self.width)
        masks = None if self.masks is None else self.masks[:, views]
        out = self.draw(Gaussians(*fields), cameras, self.settings, masks)
        shape = poses.shape[:2]
        images = (out.image, out.alpha, out.transmittance, out.depth, out.depth_origin)
        return [None if image is None else image.unflatten(0, shape) for image in images], out.stats


class _Deferred(torch.autograd.Function):
    """Keeps the inputs alone; the backward pass draws each chunk again, with a graph."""

    @staticmethod
    def forward(ctx, job: _Job, *tensors: Tensor) -> tuple[Tensor | None, ...]:
        ctx.job = job
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        parts = []
        for views in job.chunks(tensors[-1].shape[1]):
            images, stats = job.draw_part(job.part(tensors, views), views)
            parts.append(images)
            for name, count in stats.items():
                job.stats[name] = count + (0 if name in SAME_IN_ALL else job.stats.get(name, 0))
        return tuple(
            None if images[0] is None else torch.cat(images, 1).flatten(0, 1)
            for images in zip(*parts, strict=True)
        )

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        job, shape = ctx.job, ctx.saved_tensors[-1].shape[:2]
        needed = ctx.needs_input_grad[1:]
        totals = [
            torch.zeros_like(tensor) if need else None
            for tensor, need in zip(ctx.saved_tensors, needed, strict=True)
        ]
        for views in job.chunks(shape[1]):
            part = [
                tensor.detach().requires_grad_(need)
                for tensor, need in zip(job.part(ctx.saved_tensors, views), needed, strict=True)
            ]
            with torch.enable_grad():
                images, _ = job.draw_part(part, views)
            seen = [
                (image, grad.unflatten(0, shape)[:, views])
                for image, grad in zip(images, grads, strict=True)
                if grad is not None and image is not None and image.requires_grad
            ]
            torch.autograd.backward(*map(list, zip(*seen, strict=True)))
            for name, total, tensor in zip(NAMES, totals, part, strict=True):
                if total is not None and tensor.grad is not None:
                    (total[:, views] if name in PER_VIEW else total).add_(tensor.grad)
        return (None, *totals)
