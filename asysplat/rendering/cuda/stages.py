"""The stages of the GPU renderer, one after the other, as one operation to torch."""

import math
from typing import NamedTuple

import torch
import triton
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.rendering.camera_rows import CAMERA_GRADIENT, camera_gradients, camera_rows
from asysplat.rendering.cuda.backward import draw_tile_backward
from asysplat.rendering.cuda.forward import draw_tile
from asysplat.rendering.cuda.project import project
from asysplat.rendering.cuda.project_backward import project_backward
from asysplat.rendering.cuda.splat import GRADIENT, SPLAT
from asysplat.rendering.cuda.sums import sum_pairs
from asysplat.rendering.cuda.tile import TILE
from asysplat.rendering.cuda.tiles import TileLists, sort_into_tiles
from asysplat.rendering.layers import Layers
from asysplat.rendering.settings import Settings
from asysplat.scene import Cameras, Gaussians

INTERPRETED = triton.knobs.runtime.interpret  # on a CPU, in NumPy: for tests
BLOCK = 128  # Gaussians of a program
BACKWARD_BLOCK = 64
# Splats of a step. In the interpreter one that is not there takes as long as one that is.
FORWARD_STEP, BACKWARD_STEP = (2, 2) if INTERPRETED else (8, 4)
COUNTERS = 2
# A tile's 64 pixels are two a lane of one warp: no sum leaves it.
TILE_OPTIONS = {"num_warps": 1, "enable_fp_fusion": False}
PROJECT_OPTIONS = {"enable_fp_fusion": False}


def run_stages(
    gaussians: Gaussians, cameras: Cameras, settings: Settings, masks: Tensor | None
) -> Layers:
    """See `draw`."""
    stats: dict[str, int] = {}
    *layers, origin = _Draw.apply(
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
    return Layers(*layers, stats, origin)


class _Frame(NamedTuple):
    """What the kernels are told of all images."""

    scenes: int
    views: int
    num: int  # Gaussians of an image
    height: int
    width: int
    columns: int  # of tiles
    tiles: int  # of an image
    harmonics: int
    settings: Settings

    @property
    def images(self) -> int:
        return self.scenes * self.views

    @property
    def grid(self) -> tuple[int, int, int, int]:
        return self.columns, self.tiles, self.height, self.width

    @property
    def kinds(self) -> dict[str, bool]:
        """Which depth is drawn."""
        depth = self.settings.depth
        return {"DEPTH": depth not in (None, "median"), "MEDIAN": depth == "median"}


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *args):
        *tensors, (height, width), settings, masks, stats = args
        fields = [tensor.detach().contiguous() for tensor in tensors[:5]]
        cam_to_world, intrinsics = tensors[5:]
        scenes, num, harmonics = fields[4].shape[:3]
        columns = -(-width // TILE.value)
        frame = _Frame(
            scenes=scenes,
            views=intrinsics.shape[1],
            num=num,
            height=height,
            width=width,
            columns=columns,
            tiles=-(-height // TILE.value) * columns,
            harmonics=harmonics,
            settings=settings,
        )
        cameras = camera_rows(cam_to_world, intrinsics, (height, width), settings.convention)
        with torch.cuda.device_of(fields[0]):
            splats, depths, counters = _project(frame, fields, cameras)
            lists, counts, in_boxes = sort_into_tiles(
                splats, depths, frame.images, (height, width), settings.skips.ellipse
            )
            pixels = _rasterize(frame, splats, lists, masks)
        image, alpha, transmittance, depth, origins, stops, halved, last_entry, wanted = pixels
        lengths = lists.first_entry.diff()
        masked = lengths.new_zeros(()) if wanted is None else (lengths * ~wanted).sum()
        drawn = (last_entry - lists.first_entry[:-1]).sum()
        # One wait for the GPU.
        counted = (*counters.sum(0), in_boxes, masked, drawn, counts.count_nonzero())
        faint, outside, in_boxes, masked, drawn, stats["visible"] = torch.stack(counted).tolist()
        pairs = len(lists.entries)
        stats["culled_by_opacity"], stats["culled_by_frustum"] = faint, outside
        stats["pairs"] = pairs
        stats["pairs_off_ellipse"] = in_boxes - pairs if settings.skips.ellipse else 0
        stats["pairs_masked"] = masked
        stats["pairs_behind_opaque"] = pairs - masked - drawn
        stats["tile_size"] = TILE.value
        ctx.save_for_backward(*tensors, splats, counts, transmittance, origins, stops, halved)
        ctx.frame, ctx.lists, ctx.last_entry = frame, lists, last_entry
        ctx.set_materialize_grads(False)
        if origins is not None:
            ctx.mark_non_differentiable(origins)
        return image, alpha, transmittance, depth, origins

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_alpha, grad_transmittance, grad_depth, _):
        tensors, seen = ctx.saved_tensors[:7], ctx.saved_tensors[7:]
        splats, counts, transmittance, *ranks = seen
        frame, lists = ctx.frame, ctx.lists
        if grad_image is None:
            grad_image = transmittance.new_zeros(frame.images, 3, frame.height, frame.width)
        if grad_transmittance is None:
            grad_transmittance = torch.zeros_like(transmittance)
        if grad_alpha is not None:
            grad_transmittance = grad_transmittance - grad_alpha
        if grad_depth is None and frame.settings.depth is not None:
            grad_depth = torch.zeros_like(transmittance)
        convention = frame.settings.convention
        fields = [tensor.contiguous() for tensor in tensors[:5]]
        with torch.cuda.device_of(splats):
            pair_grads = splats.new_empty(len(lists.entries), GRADIENT.value)
            draw_tile_backward[(frame.images * frame.tiles,)](
                splats,
                lists.entries,
                lists.pairs,
                lists.first_entry,
                ctx.last_entry,
                transmittance,
                *ranks,
                grad_image.contiguous(),
                grad_transmittance.contiguous(),
                None if grad_depth is None else grad_depth.contiguous(),
                pair_grads,
                *frame.grid,
                convention.alpha_min,
                convention.alpha_max,
                **frame.kinds,
                STEP=BACKWARD_STEP,
                **TILE_OPTIONS,
            )
            sh_needed, cameras_needed = ctx.needs_input_grad[4], any(ctx.needs_input_grad[5:7])
            field_grads = [torch.empty_like(field) for field in fields[:4]]
            field_grads.append(torch.zeros_like(fields[4]) if sh_needed else None)
            blocks = -(-frame.num // BACKWARD_BLOCK)
            shape = (frame.images, blocks, CAMERA_GRADIENT)
            camera_grads = (
                torch.zeros(shape, dtype=torch.float64, device=splats.device)
                if cameras_needed
                else None
            )
            if blocks:
                sum_pairs[(-(-len(splats) // BLOCK),)](
                    counts,
                    lists.first_pair,
                    pair_grads,
                    len(splats),
                    CHANNELS=GRADIENT.value - (frame.settings.depth is None),
                    BLOCK=BLOCK,
                    **PROJECT_OPTIONS,
                )
                project_backward[(blocks, frame.scenes)](
                    *fields,
                    camera_rows(*tensors[5:], (frame.height, frame.width), convention),
                    counts,
                    lists.first_pair,
                    pair_grads,
                    *field_grads,
                    camera_grads,
                    frame.num,
                    frame.views,
                    convention.eps2d,
                    convention.compensation_min,
                    ANTIALIASED=frame.settings.antialiased,
                    HAS_DEPTH=frame.settings.depth is not None,
                    SH_NEEDED=sh_needed,
                    CAMERAS_NEEDED=cameras_needed,
                    COUNT=frame.harmonics,
                    BLOCK=BACKWARD_BLOCK,
                    **PROJECT_OPTIONS,
                )
        poses = (None, None)
        if cameras_needed:
            poses = camera_gradients(camera_grads.sum(1), *tensors[5:])
        return (*field_grads, *poses, *(None,) * 4)


def _project(frame: _Frame, fields: list[Tensor], cameras: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Splats, depths, counters; see `project`."""
    total = frame.images * frame.num
    blocks = -(-frame.num // BLOCK)
    device, skips, convention = cameras.device, frame.settings.skips, frame.settings.convention
    splats = torch.empty(total, SPLAT.value, dtype=torch.float32, device=device)
    depths = torch.empty(total, dtype=torch.float32, device=device)
    counters = torch.empty(blocks * frame.images, COUNTERS, dtype=torch.int32, device=device)
    if blocks:
        project[(blocks, frame.images)](
            *fields,
            cameras,
            splats,
            depths,
            counters,
            frame.num,
            frame.views,
            frame.height,
            frame.width,
            convention.alpha_min,
            math.log2(convention.alpha_min),
            convention.eps2d,
            convention.near,
            convention.compensation_min,
            ANTIALIASED=frame.settings.antialiased,
            SKIP_OPACITY=skips.opacity,
            SKIP_FRUSTUM=skips.frustum,
            OWN_EXTENT=skips.extent,
            COUNT=frame.harmonics,
            BLOCK=BLOCK,
            **PROJECT_OPTIONS,
        )
    return splats, depths, counters


def _rasterize(
    frame: _Frame, splats: Tensor, lists: TileLists, masks: Tensor | None
) -> tuple[Tensor | None, ...]:
    """Layers, what the backward pass needs, and which tiles are wanted; see `draw_tile`."""
    shape = (frame.images, frame.height, frame.width)
    settings, convention = frame.settings, frame.settings.convention
    image = splats.new_empty(frame.images, 3, *shape[1:])
    alpha, transmittance = splats.new_empty(shape), splats.new_empty(shape)
    depth = splats.new_empty(shape) if settings.depth else None
    origins = splats.new_empty(shape) if frame.kinds["DEPTH"] else None
    stops = splats.new_empty(shape, dtype=torch.int32)
    halved = splats.new_empty(shape, dtype=torch.int32) if frame.kinds["MEDIAN"] else None
    last_entry = torch.empty_like(lists.first_entry[:-1])
    wanted = None
    if masks is not None:
        counts = masks.flatten(0, 1).to(torch.float32)
        wanted = torch.nn.functional.max_pool2d(counts, TILE.value, ceil_mode=True).flatten() > 0
    draw_tile[(frame.images * frame.tiles,)](
        splats,
        lists.entries,
        lists.first_entry,
        last_entry,
        wanted,
        image,
        alpha,
        transmittance,
        depth,
        origins,
        stops,
        halved,
        *frame.grid,
        convention.alpha_min,
        convention.alpha_max,
        convention.transmittance_min,
        MASKED=wanted is not None,
        **frame.kinds,
        SKIP_OPAQUE=settings.skips.opaque,
        STEP=FORWARD_STEP,
        **TILE_OPTIONS,
    )
    return image, alpha, transmittance, depth, origins, stops, halved, last_entry, wanted
