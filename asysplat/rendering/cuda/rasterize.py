"""The kernels as one operation to torch."""

import torch
import triton
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.rendering.cuda.backward import draw_tile_backward
from asysplat.rendering.cuda.forward import draw_tile
from asysplat.rendering.cuda.sums import sum_runs
from asysplat.rendering.cuda.tiles import TileLists
from asysplat.rendering.settings import Settings

INTERPRETED = triton.knobs.runtime.interpret  # on a CPU, in NumPy: for tests
FORWARD_STEP = 8  # splats
BACKWARD_STEP = 4
WARPS = 1  # a tile's 64 pixels are two a lane, and no sum leaves the warp


def rasterize(
    splats: Float[Tensor, "M C"], lists: TileLists, settings: Settings
) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """Image, alpha and depth, see `Layers`; and [T] where each tile's list was left.

    Differentiable in `splats`.
    """
    return _Rasterize.apply(splats, lists, settings)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats: Tensor, lists: TileLists, settings: Settings):
        shape = (lists.images, lists.height, lists.width)
        image = splats.new_empty(lists.images, 3, *shape[1:])
        alpha = splats.new_empty(shape)
        depth = splats.new_empty(shape) if settings.depth else None
        last_entry = torch.empty_like(lists.first_entry[:-1])
        with torch.cuda.device_of(splats):
            draw_tile[(len(last_entry),)](
                splats,
                lists.entries,
                lists.first_entry,
                last_entry,
                image,
                alpha,
                depth,
                *_numbers(lists, settings),
                **_constants(splats, lists, settings),
                SKIP_OPAQUE=settings.skips.opaque,
                STEP=FORWARD_STEP,
                num_warps=WARPS,
            )
        ctx.save_for_backward(splats, image, alpha, depth, last_entry)
        ctx.lists, ctx.settings = lists, settings
        ctx.mark_non_differentiable(last_entry)
        return image, alpha, depth, last_entry

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_alpha, grad_depth, _):
        splats, image, alpha, depth, last_entry = ctx.saved_tensors
        lists, settings = ctx.lists, ctx.settings
        # Pairs behind opaque ones are never visited.
        grads = splats.new_zeros(len(lists.entries), splats.shape[1])
        with torch.cuda.device_of(splats):
            draw_tile_backward[(len(last_entry),)](
                splats,
                lists.entries,
                lists.pairs,
                lists.first_entry,
                last_entry,
                image,
                alpha,
                depth,
                grad_image.contiguous(),
                grad_alpha.contiguous(),
                None if grad_depth is None else grad_depth.contiguous(),
                grads,
                *_numbers(lists, settings),
                **_constants(splats, lists, settings),
                STEP=BACKWARD_STEP,
                num_warps=WARPS,
            )
        return sum_runs(grads, lists.first_pair), None, None


def _numbers(lists: TileLists, settings: Settings) -> tuple[int | float, ...]:
    """Arguments of both kernels."""
    grid = (lists.columns, lists.rows * lists.columns, lists.height, lists.width)
    c = settings.convention
    return *grid, c.alpha_min, c.alpha_max, c.transmittance_min


def _constants(splats: Tensor, lists: TileLists, settings: Settings) -> dict[str, int | bool]:
    """Constants of both kernels."""
    return {
        "HAS_DEPTH": settings.depth is not None,
        "MEDIAN": settings.depth == "median",
        "CHANNELS": splats.shape[1],
        "TILE": lists.size,
    }
