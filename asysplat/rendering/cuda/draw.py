"""Run the passes of the GPU renderer as one operation of torch."""

import math
from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.kernels.triton_utils import INTERPRETED
from asysplat.rendering import formulas
from asysplat.rendering.cuda.project import COUNTERS, pack_cameras, project
from asysplat.rendering.cuda.project_backward import project_backward, sum_pairs
from asysplat.rendering.cuda.rasterize import SavedForBackward, rasterize, rasterize_backward
from asysplat.rendering.cuda.splat import GRADIENT, SPLAT, TILE, Frame
from asysplat.rendering.cuda.tiles import TileLists, list_tiles
from asysplat.rendering.formulas import KernelInputs
from asysplat.rendering.interface import (
    RenderOutputs,
    RenderSettings,
    RenderStatistics,
    check_pairs,
    check_splats,
)
from asysplat.scene import Cameras, Gaussians

BLOCK = 128  # Gaussians of a program
BACKWARD_BLOCK = 64
SUM_BLOCK = 32  # splats of a program, whose pairs are summed
# Splats of a step. In the interpreter an invalid splat takes as long as a valid one.
FORWARD_STEP, BACKWARD_STEP = (2, 2) if INTERPRETED else (4, 2)
# A tile's 64 pixels are two for each lane of one warp: sums stay within it.
RASTER_OPTIONS = {"num_warps": 1, "enable_fp_fusion": False}
PROJECT_OPTIONS = {"enable_fp_fusion": False}


def draw(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Bool[Tensor, "B V H W"] | None = None,
    centers: Float[Tensor, "B V N 2"] | None = None,
) -> RenderOutputs:
    """Draw as `reference.draw`, in float32; pixels where `masks` is False are arbitrary."""
    if not (gaussians.means.is_cuda or INTERPRETED):
        raise InputError(
            f"render's backend is 'cuda' and its Gaussians are on {gaussians.means.device}: choose "
            "'auto', or move them with .to('cuda')."
        )
    check_splats(math.prod(cameras.intrinsics.shape[:2]), gaussians.num_gaussians)
    return formulas.apply_passes(_Passes, gaussians, cameras, settings, masks, centers)


class _Passes(torch.autograd.Function):
    """The forward and backward passes; statistics are the last result."""

    @staticmethod
    def forward(ctx, settings, size, masks, centers, *tensors):
        frame = _frame(tensors, size)
        with torch.cuda.device_of(tensors[0]):
            rows = _pack_cameras(frame, *tensors[5:], settings)
            inputs = _inputs(tensors, rows)
            splats, depths, counters = _project(frame, inputs, settings)
            lists, box_tiles = _list_tiles(frame, splats, depths, masks, settings.culling.ellipse)
            images, saved = _rasterize(frame, lists, settings)
        counted = (lists.first_entry, saved.last_entry, lists.active, lists.counts)
        counted += (counters, box_tiles if settings.culling.ellipse else None, len(lists.entries))
        stats = RenderStatistics(partial(_count, *counted))
        ctx.save_for_backward(*tensors, rows, *lists, *saved)
        ctx.settings, ctx.frame = settings, frame
        ctx.set_materialize_grads(False)
        if saved.origins is not None:
            ctx.mark_non_differentiable(saved.origins)
        return *images, stats

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_image, grad_alpha, grad_transmittance, grad_depth, *_):
        tensors, rows, rest = ctx.saved_tensors[:7], ctx.saved_tensors[7], ctx.saved_tensors[8:]
        count = len(TileLists._fields)
        lists, saved = TileLists(*rest[:count]), SavedForBackward(*rest[count:])
        frame, settings = ctx.frame, ctx.settings
        grad_image, grad_transmittance = formulas.image_gradients(
            grad_image, grad_alpha, grad_transmittance, saved.transmittance
        )
        if grad_depth is None and settings.depth is not None:
            grad_depth = torch.zeros_like(saved.transmittance)
        with torch.cuda.device_of(lists.splats):
            pair_grads = lists.splats.new_empty(len(lists.entries), GRADIENT.value)
            rasterize_backward[(frame.images * frame.tiles,)](
                splats=lists.splats,
                entries=lists.entries,
                pairs=lists.pairs,
                first_entry=lists.first_entry,
                **saved._asdict(),
                grad_image=grad_image,
                grad_transmittance=grad_transmittance,
                grad_depth=None if grad_depth is None else grad_depth.contiguous(),
                grads=pair_grads,
                **frame.grid,
                alpha_min=settings.limits.alpha_min,
                alpha_max=settings.limits.alpha_max,
                **_kinds(settings),
                STEP=BACKWARD_STEP,
                **RASTER_OPTIONS,
            )
            inputs = _inputs(tensors, rows)
            needs = {
                "SH_NEEDED": ctx.needs_input_grad[8],
                "CAMERAS_NEEDED": any(ctx.needs_input_grad[9:]),
            }
            grads = _project_backward(frame, inputs, lists, pair_grads, settings, needs)
        centers = None
        if ctx.needs_input_grad[3]:
            centers = _center_gradients(frame, lists, pair_grads)
        poses = (None, None)
        if grads.cameras is not None:
            poses = formulas.camera_gradients(grads.cameras.sum(1), *tensors[5:])
        fields = zip(grads[:5], tensors[:5], strict=True)
        fields = (None if grad is None else grad.view(field.shape) for grad, field in fields)
        return None, None, None, centers, *fields, *poses


def _frame(tensors: Sequence[Tensor], size: tuple[int, int]) -> Frame:
    """Collect the sizes for the kernels."""
    sh, intrinsics = tensors[4], tensors[-1]
    (scenes, num, sh_count), views = sh.shape[:3], intrinsics.shape[1]
    height, width = size
    columns = -(-width // TILE.value)
    return Frame(
        images=scenes * views,
        views=views,
        num=num,
        sh_count=sh_count,
        height=height,
        width=width,
        columns=columns,
        tiles=-(-height // TILE.value) * columns,
    )


def _pack_cameras(
    frame: Frame, cam_to_world: Tensor, intrinsics: Tensor, settings: RenderSettings
) -> Tensor:
    """Compute the rows of `formulas.camera_rows` in one launch."""
    shape = (frame.images, formulas.CAMERA)
    rows = torch.empty(shape, dtype=torch.float64, device=intrinsics.device)
    pack_cameras[(frame.images,)](
        cam_to_world=cam_to_world.detach().contiguous(),
        intrinsics=intrinsics.detach().contiguous(),
        rows=rows,
        height=frame.height,
        width=frame.width,
        MARGIN=settings.limits.frustum_margin,
        num_warps=1,
        **PROJECT_OPTIONS,
    )
    return rows


def _inputs(tensors: Sequence[Tensor], cameras: Tensor) -> KernelInputs:
    fields = (field.detach().contiguous().flatten(0, 1) for field in tensors[:5])
    return KernelInputs(*fields, cameras=cameras)


def _kinds(settings: RenderSettings) -> dict[str, bool]:
    depth = settings.depth
    return {"DEPTH": depth not in (None, "median"), "MEDIAN": depth == "median"}


def _project(
    frame: Frame, inputs: KernelInputs, settings: RenderSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute splats, depths and counters; see `project`."""
    total, blocks = frame.images * frame.num, -(-frame.num // BLOCK)
    device, culling, limits = inputs.means.device, settings.culling, settings.limits
    splats = torch.empty(total, SPLAT.value, dtype=torch.float32, device=device)
    depths = torch.empty(total, dtype=torch.float32, device=device)
    counters = torch.empty(blocks * frame.images, COUNTERS, dtype=torch.int32, device=device)
    if blocks:
        project[(blocks, frame.images)](
            **inputs._asdict(),
            splats=splats,
            depths=depths,
            counters=counters,
            num=frame.num,
            views=frame.views,
            height=frame.height,
            width=frame.width,
            alpha_min=limits.alpha_min,
            log_alpha_min=math.log2(limits.alpha_min),
            eps2d=limits.eps2d,
            near=limits.near,
            compensation_min=limits.compensation_min,
            ANTIALIASED=settings.antialiased,
            CULL_OPACITY=culling.opacity,
            CULL_FRUSTUM=culling.frustum,
            CULL_EXTENT=culling.extent,
            COUNT=frame.sh_count,
            BLOCK=BLOCK,
            **PROJECT_OPTIONS,
        )
    return splats, depths, counters


def _list_tiles(
    frame: Frame, splats: Tensor, depths: Tensor, masks: Tensor | None, cull_ellipse: bool
) -> tuple[TileLists, Tensor]:
    """Sort the pairs by tile and depth; also count the tiles that boxes of splats would touch.

    Depths [images * N] are infinite where there is no splat. With `cull_ellipse`, tiles of a box
    that the ellipse does not touch are left out.
    """
    tiles, device = frame.images * frame.tiles, splats.device
    # By depth across all images; the sort by tile separates the images. What is no splat comes
    # last: to leave it out, the host would have to wait for the number of splats.
    order = torch.argsort(depths, stable=True)
    programs = (-(-len(order) // BLOCK),)
    counts = torch.empty(len(depths), dtype=torch.int32, device=device)
    box_tiles = torch.empty(programs, dtype=torch.int32, device=device)
    first_pair = torch.empty_like(counts)
    common = {"splats": splats, "depths": depths, "order": order, "counts": counts}
    common |= {"total": len(order)}
    common |= {"num": frame.num, "CULL_ELLIPSE": cull_ellipse, "BLOCK": BLOCK}
    common |= frame.grid | PROJECT_OPTIONS
    if len(order):
        unused = dict.fromkeys(("ends", "tile_of", "owners", "first_pair"))
        list_tiles[programs](box_tiles=box_tiles, **unused, **common, WRITE=False)
    ends = counts[order].cumsum(0)
    pairs = int(ends[-1]) if len(order) else 0
    check_pairs(pairs)
    # A GPU sorts short keys in fewer passes.
    key = next(t for t in (torch.int16, torch.int32, torch.int64) if tiles <= torch.iinfo(t).max)
    tile_of = torch.empty(pairs, dtype=key, device=device)
    owners = torch.empty(pairs, dtype=torch.int32, device=device)
    if pairs:
        places = {"ends": ends, "tile_of": tile_of, "owners": owners, "first_pair": first_pair}
        list_tiles[programs](box_tiles=None, **places, **common, WRITE=True)
    tile_of, numbers = torch.sort(tile_of, stable=True)
    starts = torch.arange(tiles + 1, dtype=key, device=device)
    lists = TileLists(
        splats=splats,
        counts=counts,
        first_pair=first_pair,
        first_entry=torch.searchsorted(tile_of, starts),
        entries=owners[numbers],
        pairs=numbers,
        active=None if masks is None else formulas.active_tiles(masks, TILE.value),
    )
    return lists, box_tiles


def _rasterize(
    frame: Frame, lists: TileLists, settings: RenderSettings
) -> tuple[tuple[Tensor | None, ...], SavedForBackward]:
    """Draw image, alpha, transmittance, depth and its origins; also what backward needs."""
    kinds, limits, splats = _kinds(settings), settings.limits, lists.splats
    shape = (frame.images, frame.height, frame.width)
    image, alpha = splats.new_empty(frame.images, 3, *shape[1:]), splats.new_empty(shape)
    depth = splats.new_empty(shape) if settings.depth else None
    saved = SavedForBackward(
        transmittance=splats.new_empty(shape),
        stop_ranks=splats.new_empty(shape, dtype=torch.int32),
        last_entry=torch.empty_like(lists.first_entry[:-1]),
        origins=splats.new_empty(shape) if kinds["DEPTH"] else None,
        median_ranks=splats.new_empty(shape, dtype=torch.int32) if kinds["MEDIAN"] else None,
    )
    rasterize[(frame.images * frame.tiles,)](
        splats=splats,
        entries=lists.entries,
        first_entry=lists.first_entry,
        active=lists.active,
        image=image,
        alpha=alpha,
        depth=depth,
        **saved._asdict(),
        **frame.grid,
        alpha_min=limits.alpha_min,
        alpha_max=limits.alpha_max,
        transmittance_min=limits.transmittance_min,
        MASKED=lists.active is not None,
        **kinds,
        CULL_OPAQUE=settings.culling.opaque,
        STEP=FORWARD_STEP,
        **RASTER_OPTIONS,
    )
    return (image, alpha, saved.transmittance, depth, saved.origins), saved


def _count(
    first_entry: Tensor,
    last_entry: Tensor,
    active: Tensor | None,
    counts: Tensor,
    counters: Tensor,
    box_tiles: Tensor | None,
    pairs: int,
) -> dict[str, int]:
    """Count the statistics, from little of what was drawn; the program waits for the GPU once."""
    lengths, zero = first_entry.diff(), first_entry.new_zeros(())
    masked = zero if active is None else (lengths * ~active).sum()
    boxed = zero if box_tiles is None else box_tiles.sum() - pairs
    drawn = (last_entry - first_entry[:-1]).sum()
    numbers = torch.stack((*counters.sum(0), boxed, masked, drawn, counts.count_nonzero()))
    by_opacity, by_frustum, by_ellipse, by_masks, drawn, visible = numbers.tolist()
    return {
        "visible": visible,
        "culled_by_opacity": by_opacity,
        "culled_by_frustum": by_frustum,
        "pairs": pairs,
        "pairs_culled_by_ellipse": by_ellipse,
        "pairs_culled_by_masks": by_masks,
        "pairs_culled_by_opaque": pairs - by_masks - drawn,
        "tile_size": TILE.value,
    }


def _project_backward(
    frame: Frame,
    inputs: KernelInputs,
    lists: TileLists,
    pair_grads: Tensor,
    settings: RenderSettings,
    needs: dict[str, bool],
) -> KernelInputs:
    """Compute the gradients of the inputs from those of the pairs; None where not required."""
    has_depth = settings.depth is not None
    blocks, device = -(-frame.num // BACKWARD_BLOCK), pair_grads.device
    shape = (frame.images, blocks, formulas.CAMERA_GRADIENT)
    sh = torch.zeros_like(inputs.sh) if needs["SH_NEEDED"] else None
    cameras = None
    if needs["CAMERAS_NEEDED"]:
        cameras = torch.zeros(shape, dtype=torch.float64, device=device)
    grads = KernelInputs(*map(torch.empty_like, inputs[:4]), sh, cameras)
    if blocks:
        sum_pairs[(-(-len(lists.splats) // SUM_BLOCK),)](
            counts=lists.counts,
            first_pair=lists.first_pair,
            grads=pair_grads,
            num_splats=len(lists.splats),
            CHANNELS=GRADIENT.value - (not has_depth),
            BLOCK=SUM_BLOCK,
            **PROJECT_OPTIONS,
        )
        project_backward[(blocks, frame.images // frame.views)](
            **inputs._asdict(),
            counts=lists.counts,
            first_pair=lists.first_pair,
            grads=pair_grads,
            **{f"grad_{name}": grad for name, grad in grads._asdict().items()},
            num=frame.num,
            views=frame.views,
            eps2d=settings.limits.eps2d,
            compensation_min=settings.limits.compensation_min,
            ANTIALIASED=settings.antialiased,
            HAS_DEPTH=has_depth,
            **needs,
            COUNT=frame.sh_count,
            BLOCK=BACKWARD_BLOCK,
            num_warps=BACKWARD_BLOCK // 32,
            **PROJECT_OPTIONS,
        )
    return grads


def _center_gradients(
    frame: Frame, lists: TileLists, pair_grads: Float[Tensor, "P 10"]
) -> Float[Tensor, "B V N 2"]:
    """Read the gradients of the splats' centers, from what `sum_pairs` has left."""
    drawn = lists.counts > 0
    grads = lists.splats.new_zeros(len(drawn), 2)
    grads[drawn] = math.log(2) * pair_grads[lists.first_pair[drawn].long(), :2]
    return grads.view(-1, frame.views, frame.num, 2)
