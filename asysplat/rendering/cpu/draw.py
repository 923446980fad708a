"""The stages of the CPU renderer, one after the other, as one operation to torch."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.ops.cpu.threads import even_bounds, run_blocks, weighted_bounds
from asysplat.rendering.camera_rows import CAMERA_GRADIENT, camera_gradients, camera_rows
from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.backward import rasterize_backward
from asysplat.rendering.cpu.forward import rasterize
from asysplat.rendering.cpu.project import project
from asysplat.rendering.cpu.project_backward import project_backward
from asysplat.rendering.cpu.tiles import place, start_positions
from asysplat.rendering.layers import Layers
from asysplat.rendering.limits import check_pairs
from asysplat.rendering.settings import Settings
from asysplat.scene import Cameras, Gaussians

MOST_SPLATS = 2**25  # in memory at a time: 2 GiB


def draw(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: Settings,
    masks: Bool[Tensor, "B V H W"] | None = None,
) -> Layers:
    """Gaussians [B, N] and cameras [B, V] to layers of B V images, float32.

    What it draws where `masks` is False has no meaning.

    Raises:
        MemoryError: too many splats at once.
        InputError: tensors elsewhere than on a CPU; more pairs of splat and tile than a list can
            number.
    """
    if gaussians.means.device.type != "cpu":
        raise InputError(
            f"render's backend is 'cpu' and its Gaussians are on {gaussians.means.device}: choose "
            "'auto', or move them with .to('cpu')."
        )
    images = cameras.intrinsics.shape[:2].numel()
    if images * gaussians.num_gaussians > MOST_SPLATS and cameras.num_views > 1:
        raise MemoryError(f"{images} images of {gaussians.num_gaussians} Gaussians")
    stats: dict[str, int] = {}
    layers = _Draw.apply(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        cameras.cam_to_world,
        cameras.intrinsics,
        (cameras.height, cameras.width),
        settings,
        masks if settings.skips.masks else None,
        stats,
    )
    *layers, origin = layers
    return Layers(*layers, stats, origin)


class _Lists(NamedTuple):
    """Splats [images * N, 16] and which tiles they touch, sorted by tile, then by Gaussian."""

    splats: np.ndarray
    first_pair: np.ndarray  # [images * N + 1]
    first_entry: np.ndarray  # [tiles + 1]
    entries: np.ndarray  # [pairs, 2]


class _Frame(NamedTuple):
    """What the kernels are told of all images."""

    images: int
    views: int
    num: int  # Gaussians of an image
    blocks: int  # of an image
    block_size: int
    height: int
    width: int
    columns: int  # of tiles
    tiles: int  # of an image
    settings: Settings

    @property
    def size(self) -> tuple[int, int, int]:
        return self.height, self.width, self.columns

    @property
    def grid(self) -> tuple[int, int, int, int]:
        return self.columns, self.tiles, self.height, self.width

    @property
    def projection(self) -> tuple[float, ...]:
        c = self.settings.convention
        log_alpha_min = math.log2(c.alpha_min)
        return c.alpha_min, log_alpha_min, c.eps2d, c.near, c.compensation_min

    @property
    def cutoffs(self) -> tuple[np.float32, ...]:
        c = self.settings.convention
        return tuple(map(np.float32, (c.alpha_min, c.alpha_max, c.transmittance_min)))


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *args):
        *tensors, (height, width), settings, masks, stats = args
        means, _, _, _, _, cam_to_world, intrinsics = tensors
        batch, num = means.shape[:2]
        views = intrinsics.shape[1]
        blocks = max(1, min(-(-num // col.BLOCK), col.MOST_BLOCKS))
        columns = -(-width // col.TILE)
        frame = _Frame(
            images=batch * views,
            views=views,
            num=num,
            blocks=blocks,
            block_size=-(-num // blocks),
            height=height,
            width=width,
            columns=columns,
            tiles=-(-height // col.TILE) * columns,
            settings=settings,
        )
        fields = [_array(tensor) for tensor in tensors[:5]]
        cameras = _camera_rows(frame, cam_to_world, intrinsics)
        lists = _make_lists(frame, fields, cameras, stats)
        image = torch.empty(frame.images, 3, height, width)
        alpha = torch.empty(frame.images, height, width)
        transmittance = torch.empty_like(alpha)
        depth = torch.empty(frame.images, height, width) if settings.depth else None
        last_entry = np.empty(frame.images * frame.tiles, np.int64)
        wanted = _wanted_tiles(frame, masks)
        stops = np.empty(alpha.shape, np.float32)
        halved = np.empty(alpha.shape, np.float32) if settings.depth == "median" else None
        origins = torch.empty_like(alpha) if settings.depth not in (None, "median") else None
        counters = np.empty((frame.images * frame.tiles, col.COUNTERS), np.int64)
        run_blocks(
            rasterize,
            weighted_bounds(lists.first_entry),
            lists.splats,
            lists.first_entry,
            last_entry,
            lists.entries,
            wanted,
            frame.grid,
            frame.cutoffs,
            (settings.skips.rows, settings.skips.opaque),
            image.numpy(),
            alpha.numpy(),
            transmittance.numpy(),
            *_by_kind(depth, settings),
            stops,
            halved,
            None if origins is None else origins.numpy(),
            counters,
        )
        rows, in_reach = counters.sum(0).tolist()
        drawn = int((last_entry - lists.first_entry[:-1]).sum())
        masked = int(np.diff(lists.first_entry)[~wanted].sum())
        stats["pairs_masked"] = masked
        stats["pairs_behind_opaque"] = stats["pairs"] - masked - drawn
        stats["rows"] = rows
        stats["rows_out_of_reach"] = drawn * col.TILE - in_reach
        stats["rows_opaque"] = in_reach - rows
        ctx.save_for_backward(*tensors, transmittance)
        ctx.frame, ctx.lists, ctx.last_entry = frame, lists, last_entry
        ctx.seen = stops, halved, None if origins is None else origins.numpy()
        ctx.set_materialize_grads(False)
        if origins is not None:
            ctx.mark_non_differentiable(origins)
        return image, alpha, transmittance, depth, origins

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_alpha, grad_transmittance, grad_depth, _):
        *tensors, transmittance = ctx.saved_tensors
        frame, lists, settings = ctx.frame, ctx.lists, ctx.frame.settings
        if grad_image is None:
            grad_image = torch.zeros(frame.images, 3, frame.height, frame.width)
        if grad_transmittance is None:
            grad_transmittance = torch.zeros_like(transmittance)
        if grad_alpha is not None:
            grad_transmittance = grad_transmittance - grad_alpha
        pair_grads = np.empty((len(lists.entries), col.GRADIENT), np.float32)
        run_blocks(
            rasterize_backward,
            weighted_bounds(lists.first_entry),
            lists.splats,
            lists.first_entry,
            ctx.last_entry,
            lists.entries,
            frame.grid,
            frame.cutoffs,
            (settings.skips.rows, settings.skips.opaque),
            transmittance.numpy(),
            *ctx.seen,
            grad_image.contiguous().numpy(),
            grad_transmittance.contiguous().numpy(),
            *_by_kind(grad_depth, settings),
            pair_grads,
        )
        fields = [_array(tensor) for tensor in tensors[:5]]
        cameras = _camera_rows(frame, *tensors[5:])
        sh_needed, cameras_needed = ctx.needs_input_grad[4], any(ctx.needs_input_grad[5:7])
        field_grads = [_empty_like(tensor) for tensor in tensors[:4]]
        field_grads.append(_empty_like(tensors[4] if sh_needed else tensors[4][:0]))
        camera_grads = np.empty((frame.images, frame.blocks, CAMERA_GRADIENT))
        run_blocks(
            project_backward,
            even_bounds(frame.images // frame.views * frame.blocks),
            fields[0],
            fields[1].reshape(-1),
            fields[2].reshape(-1),
            *fields[3:],
            cameras,
            frame.views,
            frame.block_size,
            frame.projection,
            settings.antialiased,
            (sh_needed, cameras_needed),
            lists.first_pair,
            pair_grads,
            *(_array(grad) for grad in field_grads),
            camera_grads,
        )
        if not sh_needed:
            field_grads[-1] = None
        poses = (
            camera_gradients(torch.from_numpy(camera_grads.sum(1)), *tensors[5:])
            if cameras_needed
            else (None,) * 2
        )
        return (*field_grads, *poses, *(None,) * 4)


def _make_lists(
    frame: _Frame, fields: list[np.ndarray], cameras: np.ndarray, stats: dict[str, int]
) -> _Lists:
    """Project, and sort into tiles."""
    skips = frame.settings.skips
    splats = np.empty((frame.images * frame.num, col.SPLAT), np.float32)
    counts = np.empty(frame.images * frame.num, np.int32)
    counters = np.empty((frame.images, frame.blocks, col.PROJECT_COUNTERS), np.int64)
    histograms = np.empty((frame.images, frame.blocks, frame.tiles), np.int32)
    pieces = even_bounds(frame.images * frame.blocks)
    tiles = run_blocks(
        project,
        pieces,
        *fields,
        cameras,
        frame.views,
        frame.block_size,
        frame.size,
        frame.projection,
        frame.settings.antialiased,
        (skips.opacity, skips.frustum, skips.extent, skips.ellipse),
        splats,
        counts,
        counters,
        histograms,
    )
    first_entry = _starts(histograms.sum(1, dtype=np.int64).reshape(-1))
    first_pair = _starts(counts)
    pairs = int(first_entry[-1])
    check_pairs(pairs, int(np.diff(first_entry).max()))
    stats["visible"] = int(np.count_nonzero(counts))
    boxes, stats["culled_by_opacity"], stats["culled_by_frustum"] = counters.sum((0, 1)).tolist()
    stats["pairs"] = pairs
    stats["pairs_off_ellipse"] = boxes - pairs if skips.ellipse else 0
    stats["tile_size"] = col.TILE
    positions = np.empty(histograms.shape, np.int64)
    run_blocks(start_positions, even_bounds(frame.images), histograms, first_entry, positions)
    entries = np.empty((pairs, 2), np.int32)
    run_blocks(
        place,
        pieces,
        np.concatenate(tiles),
        first_pair,
        positions,
        frame.num,
        frame.block_size,
        entries,
    )
    return _Lists(splats, first_pair, first_entry, entries)


def _wanted_tiles(frame: _Frame, masks: Tensor | None) -> np.ndarray:
    """[images * tiles] whether any pixel counts."""
    if masks is None:
        return np.ones(frame.images * frame.tiles, np.bool_)
    counts = masks.flatten(0, 1).to(torch.float32)
    return torch.nn.functional.max_pool2d(counts, col.TILE, ceil_mode=True).flatten().numpy() > 0


def _by_kind(depth: Tensor | None, settings: Settings) -> tuple[np.ndarray | None, ...]:
    """As the accumulated depth and as the median: one of them at most is asked for."""
    if depth is None:
        return None, None
    array = depth.contiguous().numpy()
    return (None, array) if settings.depth == "median" else (array, None)


def _empty_like(tensor: Tensor) -> Tensor:
    """In NumPy's memory, whose first touch of large arrays is several times faster than torch's."""
    return torch.from_numpy(np.empty_like(tensor.detach().numpy(), order="C"))


def _starts(counts: np.ndarray) -> np.ndarray:
    """[0, c_0, c_0 + c_1, ...]"""
    starts = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=starts[1:])
    return starts


def _array(tensor: Tensor) -> np.ndarray:
    """[B, N, ...] as [B * N, ...], without a copy where memory allows it."""
    return tensor.detach().contiguous().flatten(0, 1).numpy()


def _camera_rows(frame: _Frame, cam_to_world: Tensor, intrinsics: Tensor) -> np.ndarray:
    """[images, 20] float64, see `camera_rows`."""
    size = (frame.height, frame.width)
    return camera_rows(cam_to_world, intrinsics, size, frame.settings.convention).numpy()
