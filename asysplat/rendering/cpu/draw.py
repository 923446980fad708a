"""Run the passes of the CPU renderer as one operation of torch."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.kernels.simd.threads import even_bounds, run_blocks, weighted_bounds
from asysplat.rendering import formulas
from asysplat.rendering.cpu import project as projection
from asysplat.rendering.cpu import rasterize as raster
from asysplat.rendering.cpu import splat as col
from asysplat.rendering.cpu.project import Projected, project
from asysplat.rendering.cpu.project_backward import LOG_2, project_backward
from asysplat.rendering.cpu.rasterize import BlendedDepth, MedianDepth, SavedForBackward
from asysplat.rendering.cpu.splat import SPLAT, TILE, Frame, ProjectSettings, RasterSettings
from asysplat.rendering.cpu.tiles import TileLists, scatter_pairs, start_positions
from asysplat.rendering.formulas import KernelInputs
from asysplat.rendering.interface import RenderOutputs, RenderSettings, check_pairs
from asysplat.scene import Cameras, Gaussians

MAX_SPLATS = 2**25  # in memory at a time: 2 GiB
BLOCK = 2048  # Gaussians of a task; more if an image would have over MAX_BLOCKS
MAX_BLOCKS = 64


def draw(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Bool[Tensor, "B V H W"] | None = None,
    centers: Float[Tensor, "B V N 2"] | None = None,
) -> RenderOutputs:
    """Draw as `reference.draw`, in float32; pixels where `masks` is False are arbitrary."""
    if gaussians.means.device.type != "cpu":
        raise InputError(
            f"render's backend is 'cpu' and its Gaussians are on {gaussians.means.device}: choose "
            "'auto', or move them with .to('cpu')."
        )
    images = math.prod(cameras.intrinsics.shape[:2])
    if images * gaussians.num_gaussians > MAX_SPLATS and cameras.num_views > 1:
        raise MemoryError(f"{images} images of {gaussians.num_gaussians} Gaussians")
    return formulas.apply_passes(_Passes, gaussians, cameras, settings, masks, centers)


class _Passes(torch.autograd.Function):
    """The forward and backward passes; statistics are the last result."""

    @staticmethod
    def forward(ctx, settings, size, masks, centers, *tensors):
        frame = _frame(tensors, size, settings)
        inputs = _inputs(tensors, size, settings)
        stats: dict[str, int] = {}
        lists = _list_tiles(frame, *_project(frame, inputs), masks, stats)
        images, saved, auxiliary = _rasterize(frame, lists, settings.depth, stats)
        _, _, transmittance, _, origins = images
        ctx.save_for_backward(*tensors, transmittance)  # an output must be saved here
        ctx.settings, ctx.size, ctx.frame, ctx.lists = settings, size, frame, lists
        ctx.saved, ctx.auxiliary = saved[1:], auxiliary  # without the transmittance
        ctx.set_materialize_grads(False)
        if origins is not None:
            ctx.mark_non_differentiable(origins)
        return *images, stats

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_alpha, grad_transmittance, grad_depth, *_):
        *tensors, transmittance = ctx.saved_tensors
        frame, lists = ctx.frame, ctx.lists
        grad_image, grad_transmittance = formulas.image_gradients(
            grad_image, grad_alpha, grad_transmittance, transmittance
        )
        grads = raster.Gradients(
            image=grad_image.numpy(),
            transmittance=grad_transmittance.numpy(),
            pairs=np.empty((len(lists.entries), col.GRADIENT), np.float32),
        )
        saved = SavedForBackward(transmittance.numpy(), *ctx.saved)
        depths = _depths(ctx.settings.depth, grad_depth, ctx.auxiliary)
        tiles = weighted_bounds(lists.first_entry)
        run_blocks(raster.rasterize_backward, tiles, lists, frame, saved, grads, *depths)
        inputs = _inputs(tensors, ctx.size, ctx.settings)
        needs = (ctx.needs_input_grad[8], any(ctx.needs_input_grad[9:]))
        pairs = (lists.first_pair, grads.pairs)
        centers = _center_gradients(frame, *pairs) if ctx.needs_input_grad[3] else None
        fields = _project_backward(frame, inputs, needs, pairs, tensors)
        return None, None, None, centers, *fields


def _frame(tensors: Sequence[Tensor], size: tuple[int, int], settings: RenderSettings) -> Frame:
    """Collect sizes and settings for the kernels."""
    means, intrinsics = tensors[0], tensors[-1]
    (scenes, num), views = means.shape[:2], intrinsics.shape[1]
    height, width = size
    blocks = max(1, min(-(-num // BLOCK), MAX_BLOCKS))
    columns = -(-width // TILE)
    limits, culling = settings.limits, settings.culling
    return Frame(
        images=scenes * views,
        views=views,
        num=num,
        blocks=blocks,
        block_size=-(-num // blocks),
        height=height,
        width=width,
        columns=columns,
        tiles=-(-height // TILE) * columns,
        project=ProjectSettings(
            alpha_min=limits.alpha_min,
            log_alpha_min=math.log2(limits.alpha_min),
            eps2d=limits.eps2d,
            near=limits.near,
            compensation_min=limits.compensation_min,
            antialiased=settings.antialiased,
            cull_opacity=culling.opacity,
            cull_frustum=culling.frustum,
            cull_extent=culling.extent,
            cull_ellipse=culling.ellipse,
        ),
        raster=RasterSettings(
            alpha_min=np.float32(limits.alpha_min),
            alpha_max=np.float32(limits.alpha_max),
            transmittance_min=np.float32(limits.transmittance_min),
            cull_rows=culling.rows,
            cull_opaque=culling.opaque,
        ),
    )


def _inputs(
    tensors: Sequence[Tensor], size: tuple[int, int], settings: RenderSettings
) -> KernelInputs:
    *fields, cam_to_world, intrinsics = tensors
    cameras = formulas.camera_rows(cam_to_world, intrinsics, size, settings.limits)
    return KernelInputs(*(_array(field) for field in fields), cameras=cameras.numpy())


def _project(frame: Frame, inputs: KernelInputs) -> tuple[Projected, list[np.ndarray]]:
    """Compute the splats and, in parts, the tile of each pair."""
    projected = Projected(
        splats=np.empty((frame.images * frame.num, SPLAT), np.float32),
        counts=np.empty(frame.images * frame.num, np.int32),
        counters=np.empty((frame.images, frame.blocks, projection.COUNTERS), np.int64),
        histograms=np.empty((frame.images, frame.blocks, frame.tiles), np.int32),
    )
    blocks = even_bounds(frame.images * frame.blocks)
    return projected, run_blocks(project, blocks, inputs, frame, projected)


def _list_tiles(
    frame: Frame,
    projected: Projected,
    tiles: list[np.ndarray],
    masks: Tensor | None,
    stats: dict[str, int],
) -> TileLists:
    """Sort the pairs by tile."""
    histograms = projected.histograms
    first_entry = _starts(histograms.sum(1, dtype=np.int64).reshape(-1))
    lengths = np.diff(first_entry)
    pairs = int(first_entry[-1])
    check_pairs(pairs, int(lengths.max()))
    active = np.ones(len(lengths), np.bool_)
    if masks is not None:
        active = formulas.active_tiles(masks, TILE).numpy()
    lists = TileLists(
        splats=projected.splats,
        first_pair=_starts(projected.counts),
        first_entry=first_entry,
        entries=np.empty((pairs, 2), np.int32),
        active=active,
    )
    box_tiles, by_opacity, by_frustum = projected.counters.sum((0, 1)).tolist()
    stats["visible"] = int(np.count_nonzero(projected.counts))
    stats["culled_by_opacity"], stats["culled_by_frustum"] = by_opacity, by_frustum
    stats["pairs"] = pairs
    stats["pairs_culled_by_ellipse"] = box_tiles - pairs if frame.project.cull_ellipse else 0
    stats["pairs_culled_by_masks"] = int(lengths[~lists.active].sum())
    stats["tile_size"] = TILE
    positions = np.empty(histograms.shape, np.int64)
    run_blocks(start_positions, even_bounds(frame.images), histograms, first_entry, positions)
    blocks = even_bounds(frame.images * frame.blocks)
    tile_of = np.concatenate(tiles)
    run_blocks(scatter_pairs, blocks, tile_of, lists.first_pair, positions, frame, lists.entries)
    return lists


def _rasterize(
    frame: Frame, lists: TileLists, depth: str | None, stats: dict[str, int]
) -> tuple[tuple[Tensor | None, ...], SavedForBackward, np.ndarray | None]:
    """Draw image, alpha, transmittance, depth and its origins; also what backward needs."""
    image = torch.empty(frame.images, 3, frame.height, frame.width)
    alpha = torch.empty(frame.images, frame.height, frame.width)
    transmittance = torch.empty_like(alpha)
    drawn_depth = torch.empty_like(alpha) if depth else None
    origins = torch.empty_like(alpha) if depth not in (None, "median") else None
    auxiliary = None if origins is None else origins.numpy()
    if depth == "median":
        auxiliary = np.empty(alpha.shape, np.float32)
    saved = SavedForBackward(
        transmittance=transmittance.numpy(),
        stop_ranks=np.empty(alpha.shape, np.float32),
        last_entry=np.empty(frame.images * frame.tiles, np.int64),
        counters=np.empty((frame.images * frame.tiles, raster.COUNTERS), np.int64),
    )
    images = raster.OutputImages(image.numpy(), alpha.numpy())
    depths = _depths(depth, drawn_depth, auxiliary)
    tiles = weighted_bounds(lists.first_entry)
    run_blocks(raster.rasterize, tiles, lists, frame, images, saved, *depths)
    rows, in_extent = saved.counters.sum(0).tolist()
    drawn = int((saved.last_entry - lists.first_entry[:-1]).sum())
    stats["pairs_culled_by_opaque"] = stats["pairs"] - stats["pairs_culled_by_masks"] - drawn
    stats["rows"] = rows
    stats["rows_culled_by_extent"] = drawn * TILE - in_extent
    stats["rows_culled_by_opaque"] = in_extent - rows
    return (image, alpha, transmittance, drawn_depth, origins), saved, auxiliary


def _project_backward(
    frame: Frame,
    inputs: KernelInputs,
    needs: tuple[bool, bool],
    pairs: tuple[np.ndarray, np.ndarray],
    tensors: Sequence[Tensor],
) -> tuple[Tensor | None, ...]:
    """Compute the gradients of `tensors`: the fields of Gaussians, poses and intrinsics."""
    *fields, cam_to_world, intrinsics = tensors
    field_grads = [_empty_like(field) for field in fields[:4]]
    field_grads.append(_empty_like(fields[4] if needs[0] else fields[4][:0]))
    camera_grads = np.empty((frame.images, frame.blocks, formulas.CAMERA_GRADIENT))
    grads = KernelInputs(*(_array(grad) for grad in field_grads), cameras=camera_grads)
    flat = inputs._replace(quats=inputs.quats.reshape(-1), scales=inputs.scales.reshape(-1))
    blocks = even_bounds(frame.images // frame.views * frame.blocks)
    run_blocks(project_backward, blocks, flat, frame, *pairs, needs, grads)
    *others, sh = field_grads
    poses = (None, None)
    if needs[1]:
        rows = torch.from_numpy(camera_grads.sum(1))
        poses = formulas.camera_gradients(rows, cam_to_world, intrinsics)
    return (*others, sh if needs[0] else None, *poses)


def _center_gradients(
    frame: Frame, first_pair: np.ndarray, pair_grads: np.ndarray
) -> Float[Tensor, "B V N 2"]:
    counts = torch.from_numpy(first_pair).diff()
    owners = torch.arange(len(counts)).repeat_interleave(counts)
    sums = torch.zeros(len(counts), 2, dtype=torch.float64)
    sums.index_add_(0, owners, LOG_2 * torch.from_numpy(pair_grads[:, [col.G_X, col.G_Y]]).double())
    return sums.float().view(-1, frame.views, frame.num, 2)


def _depths(
    kind: str | None, depth: Tensor | None, auxiliary: np.ndarray | None
) -> tuple[BlendedDepth | None, MedianDepth | None]:
    """Wrap a depth, or its gradient, as the requested kind; the other kind is None.

    `auxiliary` holds the origins of a blended depth, or the ranks of a median depth.
    """
    if depth is None or auxiliary is None:
        return None, None
    array = depth.contiguous().numpy()
    if kind == "median":
        return None, MedianDepth(array, auxiliary)
    return BlendedDepth(array, auxiliary), None


def _empty_like(tensor: Tensor) -> Tensor:
    return torch.from_numpy(np.empty_like(tensor.detach().numpy(), order="C"))


def _starts(counts: np.ndarray) -> np.ndarray:
    """Compute [0, c_0, c_0 + c_1, ...]."""
    return np.concatenate(([0], np.cumsum(counts, dtype=np.int64)))


def _array(tensor: Tensor) -> np.ndarray:
    """Convert [B, N, ...] to an array [B * N, ...], without a copy if the memory layout allows."""
    return tensor.detach().contiguous().flatten(0, 1).numpy()
