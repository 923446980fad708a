"""The renderer: all views at once, or a few at a time in the memory of these."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.kernels.dispatch import (
    check_device,
    check_float,
    choose_fastest,
    look_up_backend,
    without_autocast,
)
from asysplat.rendering import cpu, reference
from asysplat.rendering.interface import (
    INRIA,
    BlendingLimits,
    Projections,
    RenderOutputs,
    RenderSettings,
    RenderStatistics,
)
from asysplat.rendering.reference.project import project_centers
from asysplat.scene import Cameras, Gaussians, TensorRecord

DEPTH_SWITCH = {True: "expected", False: None}  # meanings of depth=True and depth=False
MIN_ALPHA = 1e-6  # avoids division by 0; an alpha below 1/255 is exactly 0


def _draw_by_cuda(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Bool[Tensor, "B V H W"] | None = None,
    centers: Float[Tensor, "B V N 2"] | None = None,
) -> RenderOutputs:
    """Import Triton at the first call: a machine without a GPU may lack it."""
    try:
        from asysplat.rendering.cuda.draw import draw
    except ImportError as error:
        raise InputError("render's backend 'cuda' needs triton: pip install triton.") from error
    return draw(gaussians, cameras, settings, masks, centers)


BACKENDS = {"reference": reference.draw, "cpu": cpu.draw, "cuda": _draw_by_cuda}


@dataclass(frozen=True)
class Rendering(TensorRecord):
    """The result of `render`, in float32, or in float64 for float64 inputs.

    Args:
        image: [..., V, 3, H, W] >= 0; no upper bound.
        alpha: [..., V, H, W] in [0, 1).
        depth: [..., V, H, W] in scene units, 0 without a visible Gaussian; None if not requested.
        stats: visible (pairs of Gaussian and view), pairs (of these with tiles), tile_size, and
            what the backend culled.
        projections: the Gaussians as 2D Gaussians; None if not requested.
    """

    image: Float[Tensor, "*batch V 3 H W"]
    alpha: Float[Tensor, "*batch V H W"]
    depth: Float[Tensor, "*batch V H W"] | None
    stats: dict[str, int] | RenderStatistics
    projections: Projections | None = None


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor | None = None,
    backend: str = "auto",
    depth: bool | str = True,
    *,
    antialiased: bool = False,
    sh_degree: int | None = None,
    limits: BlendingLimits = INRIA,
    masks: Bool[Tensor, "*batch V H W"] | None = None,
    views_at_once: int | None = None,
    projections: bool = False,
    validate: bool = False,
) -> Rendering:
    """Render every view, by alpha compositing in depth order (Kerbl et al. 2023).

    Differentiable in all fields of `gaussians` and `cameras`, and in `background`; a culled
    Gaussian (see `reference.project.project`) has gradient 0. Half-precision inputs are computed in
    float32, also under autocast. The kernels' errors stay near 1e-6 for quaternions of any length,
    and for scales from 1e-12 to 1e8 in one scene. The same inputs give the same bits on one device,
    and on a CPU with any number of threads.

    Args:
        gaussians: [..., N].
        cameras: [..., V], with the batch dimensions of `gaussians`. Skew is ignored.
        background: RGB [3], or [..., V, 3] for each view; None is black.
        backend: "reference", "cpu", "cuda" or "auto": the fast backend of the device, the reference
            for float64, and on a GPU without Triton.
        depth: True or "expected": sum_i w_i z_i / alpha. "accumulated": not divided by alpha.
            "median": z of the Gaussian that takes the transmittance to half or below. False: none.
        antialiased: lower opacities by what the dilation adds to a splat's area (Yu et al. 2024).
        sh_degree: ignore SH of higher degrees.
        limits: cut-offs of alpha compositing; see `BLENDING_LIMITS`.
        masks: True where a pixel counts; the others show the background, and tiles without a pixel
            that counts cost nothing.
        views_at_once: draw this many views of each scene at a time, keep only the inputs, and draw
            again in the backward pass (deferred backpropagation, Zhang et al. 2022): the same
            gradient with the memory of these views. None draws all at once.
        projections: also return every Gaussian as a 2D Gaussian, whose centers get a gradient.
        validate: check every number of `gaussians` and `cameras` first.

    Raises:
        InputError: an unknown backend or depth; incompatible shapes, devices or types; more pairs
            of Gaussian and tile, or of Gaussian and view, than a list can number; `projections`
            with `views_at_once`; a CUDA graph being captured; with `validate`, everything that
            `Gaussians.validate` and `Cameras.validate` refuse.

    Example:
        >>> from asysplat import load, open_photographs, render
        >>> views = open_photographs("my_scene", height=64, views=4).inputs
        >>> out = render(load("shipped")(views), views.cameras)
        >>> out.image.shape
        torch.Size([4, 3, 64, 64])
        >>> out.depth.shape
        torch.Size([4, 64, 64])
    """
    if gaussians.means.is_cuda and torch.cuda.is_current_stream_capturing():
        raise InputError(
            "render waits for the GPU to count pairs, which a CUDA graph cannot hold: call it "
            "outside torch.cuda.graph."
        )
    if sh_degree not in (None, 0, 1, 2, 3):
        raise InputError(f"render's sh_degree is {sh_degree!r}: choose 0, 1, 2, 3 or None.")
    if validate:
        gaussians.validate("render's gaussians")
        cameras.validate("render's cameras")
    batch = _check(gaussians, cameras, background, masks)
    dtype = torch.promote_types(gaussians.means.dtype, cameras.cam_to_world.dtype)
    dtype = torch.promote_types(dtype, torch.float32)
    kind = DEPTH_SWITCH[depth] if isinstance(depth, bool) else depth
    settings = RenderSettings(limits, antialiased, kind)
    with without_autocast(gaussians.means):
        scenes = gaussians.map(lambda t: _one_batch(t.to(dtype), batch))
        if sh_degree is not None:
            scenes = replace(scenes, sh=scenes.sh[..., : (sh_degree + 1) ** 2, :])
        views = cameras.map(lambda t: _one_batch(t.to(dtype), batch))
        fastest = choose_fastest(scenes.means, "reference", "asysplat.rendering.self_check:render")
        auto = BACKENDS[fastest]
        draw = look_up_backend("render", {"auto": auto, **BACKENDS}, backend)
        view_masks = None if masks is None else _one_batch(masks, batch)
        projected = centers = None
        if projections:
            projected = project_centers(scenes, views, settings)
            projected = projected.map(lambda t: t.reshape(*batch, *t.shape[1:]))
            # A leaf: the means get their gradients from the passes.
            projected.means2d.requires_grad_(torch.is_grad_enabled())
            centers = _one_batch(projected.means2d, batch)
        out = draw_in_chunks(draw, scenes, views, settings, view_masks, views_at_once, centers)

        def shaped(images: Tensor) -> Tensor:
            return images.to(dtype).unflatten(0, (*batch, cameras.num_views))

        image, alpha, transmittance = map(shaped, (out.image, out.alpha, out.transmittance))
        distance = None if out.depth is None else shaped(_depth(out.depth, out, settings.depth))
        if masks is not None:
            image = image.where(masks[..., None, :, :], 0)
            alpha, transmittance = alpha.where(masks, 0), transmittance.where(masks, 1)
            distance = None if distance is None else distance.where(masks, 0)
        if background is not None:
            image = image + transmittance[..., None, :, :] * background.to(dtype)[..., None, None]
        return Rendering(image, alpha, distance, out.stats, projected)


def blending_weights(
    gaussians: Gaussians, cameras: Cameras, masks: Bool[Tensor, "V H W"] | None = None
) -> Float[Tensor, "N"]:
    """Compute the sum of each Gaussian's blending weights over all pixels, or those in masks."""
    # An image is linear in the Gaussians' colors, with these weights as its gradient.
    gray = torch.zeros_like(gaussians.sh[:, :1], requires_grad=True)
    with torch.enable_grad():
        scene = replace(gaussians, sh=gray)
        for view in range(cameras.num_views):  # the images of all views would take much memory
            of_view = None if masks is None else masks[view : view + 1]
            rendering = render(scene, cameras.select([view]), depth=False, masks=of_view)
            rendering.image[:, 0].sum().backward(inputs=gray)
    assert gray.grad is not None
    return gray.grad[:, 0, 0] / SH_C0


def _depth(depth: Tensor, out: RenderOutputs, kind: str | None) -> Tensor:
    """Compute the depth [I, H, W] of the requested kind."""
    if kind == "median":
        return depth
    origin = 0 if out.depth_origin is None else out.depth_origin
    if kind == "accumulated":
        return depth + origin * out.alpha
    return depth / out.alpha.clamp_min(MIN_ALPHA) + origin * (out.alpha > 0)


def _one_batch(tensor: Tensor, batch: tuple[int, ...]) -> Tensor:
    """Flatten the batch dimensions into one, of length 1 without any."""
    return tensor.reshape(math.prod(batch), *tensor.shape[len(batch) :])


def _check(
    gaussians: Gaussians, cameras: Cameras, background: Tensor | None, masks: Tensor | None
) -> tuple[int, ...]:
    """Check that all tensors are compatible; return their batch dimensions."""
    batch, views = tuple(gaussians.opacities.shape[:-1]), tuple(cameras.intrinsics.shape[:-2])
    if batch != views[:-1]:
        raise InputError(
            f"render's gaussians have the batch dimensions {batch} and its cameras {views[:-1]}: "
            "give both the same."
        )
    if background is not None and tuple(background.shape) not in ((3,), (*views, 3)):
        raise InputError(
            f"render's background has shape {tuple(background.shape)}: "
            f"expected (3,) or {(*views, 3)}."
        )
    pixels = (*views, cameras.height, cameras.width)
    if masks is not None and (tuple(masks.shape) != pixels or masks.dtype != torch.bool):
        raise InputError(
            f"render's masks are {masks.dtype} of shape {tuple(masks.shape)}: expected torch.bool "
            f"of shape {pixels}, one number a pixel."
        )
    named = {f"gaussians.{f.name}": getattr(gaussians, f.name) for f in fields(gaussians)}
    named |= {f"cameras.{name}": getattr(cameras, name) for name in ("intrinsics", "cam_to_world")}
    if background is not None:
        named["background"] = background
    for name, tensor in named.items():
        check_device("render", name, tensor, "gaussians.means", gaussians.means)
        check_float("render", name, tensor)
    return batch


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
    ) -> tuple[list[Tensor | None], dict[str, int] | RenderStatistics]:
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
            fields = [getattr(gaussians, name) for name in NAMES if name not in PER_VIEW]
            poses = (cameras.cam_to_world, cameras.intrinsics)
            *images, origins, stats = _Deferred.apply(draw_views, slices, *fields, *poses)
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
    def forward(ctx, draw_views, slices, *tensors):
        ctx.draw_views, ctx.slices = draw_views, slices
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        parts, stats = [], {}
        for views in slices:
            images, chunk_stats = draw_views(views, _select(tensors, views))
            parts.append(images)
            for name, count in chunk_stats.items():  # now, as they hold memory of their chunk
                stats[name] = count + (0 if name in NOT_SUMMED else stats.get(name, 0))
        whole = (
            None if images[0] is None else torch.cat(images, 1).flatten(0, 1)
            for images in zip(*parts, strict=True)
        )
        return *whole, stats

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        shape, needed = ctx.saved_tensors[-1].shape[:2], ctx.needs_input_grad[2:]
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
                for image, grad in zip(images, grads[:-1], strict=True)
                if grad is not None and image is not None and image.requires_grad
            ]
            drawn, drawn_grads = map(list, zip(*outputs, strict=True))
            torch.autograd.backward(drawn, drawn_grads)
            for name, total, tensor in zip(NAMES, totals, inputs, strict=True):
                if total is not None and tensor.grad is not None:
                    (total[:, views] if name in PER_VIEW else total).add_(tensor.grad)
        return (None, None, *totals)


def _select(tensors: Sequence[Tensor], views: slice) -> list[Tensor]:
    *fields, poses, intrinsics = tensors
    return [*fields, poses[:, views], intrinsics[:, views]]
