"""Run the passes of the GPU renderer as one operation of torch."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.errors import InputError
from asysplat.kernels.host import HostCopy
from asysplat.kernels.triton_utils import INTERPRETED
from asysplat.rendering import formulas
from asysplat.rendering.cuda.project import COUNTERS, pack_cameras, project
from asysplat.rendering.cuda.project_backward import project_backward, sum_pairs
from asysplat.rendering.cuda.rasterize import SavedForBackward, rasterize, rasterize_backward
from asysplat.rendering.cuda.splat import GRADIENT, SPLAT, TILE, Frame
from asysplat.rendering.cuda.tiles import TileLists, list_entries, list_tiles
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
ENTRY_BLOCK = 256  # pairs of a program
MOST_ROWS = 2**22  # gradients of pairs in memory at a time
# Splats of a step. In the interpreter an invalid splat takes as long as a valid one.
FORWARD_STEP, BACKWARD_STEP = (2, 2) if INTERPRETED else (4, 2)
# A tile's 64 pixels are two for each lane of one warp: sums stay within it.
RASTER_OPTIONS = {"num_warps": 1, "enable_fp_fusion": False}
PROJECT_OPTIONS = {"enable_fp_fusion": False}

# Pairs that the last images of a size had, and some more.
_room: dict[tuple[torch.device, int, int, int], int] = {}


@dataclass(frozen=True)
class Pairs:
    """Splats and their pairs with tiles, counted and not yet listed."""

    splats: Tensor
    depths: Tensor  # [images * N] infinite where there is no splat
    order: Tensor  # [images * N] splats by depth
    counts: Tensor  # [images * N] tiles of each splat
    ends: Tensor  # [images * N] 1 + the index of a splat's last pair, in `order`
    box_tiles: Tensor  # [programs] tiles that boxes of splats would touch
    last_end: HostCopy

    @cached_property
    def number(self) -> int:
        """The number of pairs, for which the host waits."""
        number = sum(self.last_end.read().tolist())  # there is none without Gaussians
        check_pairs(number)
        return number


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
            pairs = _count_pairs(frame, splats, depths, settings)
            active = None if masks is None else formulas.active_tiles(masks, TILE.value)
            keep = any(ctx.needs_input_grad)
            lists, images, saved = _draw_pairs(frame, pairs, settings, keep, active)
            many = keep and pairs.number > MOST_ROWS
            ctx.first_entry = HostCopy(lists.first_entry) if many else None
        counted = (lists.first_entry, saved.last_entry, lists.active, lists.counts, counters)
        counted += (pairs.box_tiles if settings.culling.ellipse else None, pairs.number)
        stats = RenderStatistics(partial(_count, *counted))
        ctx.save_for_backward(*tensors, rows, *lists, *saved)
        ctx.settings, ctx.frame, ctx.pairs = settings, frame, pairs.number
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
        grad_depth = None if grad_depth is None else grad_depth.contiguous()
        with torch.cuda.device_of(lists.splats):
            arriving = (grad_image, grad_transmittance, grad_depth)
            groups = _group_tiles(frame, ctx.pairs, ctx.first_entry)
            splat_grads = _rasterize_backward(frame, lists, saved, arriving, settings, *groups)
            inputs = _inputs(tensors, rows)
            needs = {
                "SH_NEEDED": ctx.needs_input_grad[8],
                "CAMERAS_NEEDED": any(ctx.needs_input_grad[9:]),
            }
            grads = _project_backward(frame, inputs, lists.counts, splat_grads, settings, needs)
        centers = None
        if ctx.needs_input_grad[3]:
            centers = _center_gradients(frame, lists.counts, splat_grads)
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


def _count_pairs(frame: Frame, splats: Tensor, depths: Tensor, settings: RenderSettings) -> Pairs:
    """Sort the splats by depth, and count the tiles of each and of its box."""
    # By depth across all images; the sort by tile separates the images. What is no splat comes
    # last: to leave it out, the host would have to wait for the number of splats.
    order = torch.argsort(depths, stable=True)
    counts = torch.empty(len(order), dtype=torch.int32, device=splats.device)
    box_tiles = counts.new_empty(-(-len(order) // BLOCK))
    _visit_tiles(frame, settings, splats, depths, order, counts, box_tiles=box_tiles)
    ends = counts[order].cumsum(0)
    return Pairs(splats, depths, order, counts, ends, box_tiles, HostCopy(ends[-1:]))


def _draw_pairs(
    frame: Frame, pairs: Pairs, settings: RenderSettings, keep: bool, active: Tensor | None
) -> tuple[TileLists, tuple[Tensor | None, ...], SavedForBackward]:
    """List the pairs and draw them; again, if they are more than there was room for."""
    similar = (pairs.splats.device, frame.images, frame.height, frame.width)
    # Taken out until it has been enough: another drawing starts anew if memory does not hold it.
    room, drawn = _room.pop(similar, 0) or pairs.number, False
    while not drawn:
        lists = _list_pairs(frame, pairs, room, settings, keep, active)
        images, saved = _rasterize(frame, lists, settings)
        # A GPU knows the number long before it has drawn, and has work while the host waits.
        drawn, room = pairs.number <= room, max(pairs.number, room)
    _room[similar] = max(pairs.number + pairs.number // 8, room - room // 64)
    return lists, images, saved


def _list_pairs(
    frame: Frame,
    pairs: Pairs,
    room: int,
    settings: RenderSettings,
    keep: bool,
    active: Tensor | None,
) -> TileLists:
    """Sort pairs, at most `room` of them, by tile and depth; `keep` what gradients need."""
    tiles, counts = frame.images * frame.tiles, pairs.counts
    # A GPU sorts short keys in fewer passes. Room that no pair takes comes last.
    key = next(t for t in (torch.int16, torch.int32, torch.int64) if tiles < torch.iinfo(t).max)
    tile_of = torch.full((room,), torch.iinfo(key).max, dtype=key, device=counts.device)
    owners, first_pair = counts.new_empty(room), torch.empty_like(counts)
    lists = {"tile_of": tile_of, "owners": owners, "first_pair": first_pair, "room": room}
    visited = (pairs.splats, pairs.depths, pairs.order, counts)
    _visit_tiles(frame, settings, *visited, ends=pairs.ends, **lists)
    tile_of, numbers = torch.sort(tile_of, stable=True)
    entries, places = torch.empty_like(owners), torch.empty_like(owners) if keep else None
    if room:
        list_entries[(-(-room // ENTRY_BLOCK),)](
            numbers, owners, entries, places, room, KEEP=keep, BLOCK=ENTRY_BLOCK
        )
    starts = torch.arange(tiles + 1, dtype=key, device=counts.device)
    first_entry = torch.searchsorted(tile_of, starts)
    return TileLists(pairs.splats, counts, first_pair, first_entry, entries, places, active)


def _visit_tiles(
    frame: Frame,
    settings: RenderSettings,
    splats: Tensor,
    depths: Tensor,
    order: Tensor,
    counts: Tensor,
    box_tiles: Tensor | None = None,
    **pairs: Tensor | int,
) -> None:
    """Count the pairs, or list them, if there is where to; see `list_tiles`."""
    unused = {"ends": None, "tile_of": None, "owners": None, "first_pair": None, "room": 0}
    if len(order):
        list_tiles[(-(-len(order) // BLOCK),)](
            splats=splats,
            depths=depths,
            order=order,
            counts=counts,
            box_tiles=box_tiles,
            **unused | pairs,
            num_splats=len(order),
            num=frame.num,
            **frame.grid,
            WRITE=bool(pairs),
            CULL_ELLIPSE=settings.culling.ellipse,
            BLOCK=BLOCK,
            **PROJECT_OPTIONS,
        )


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


def _group_tiles(frame: Frame, pairs: int, first_entry: HostCopy | None) -> tuple[list[int], int]:
    """Group the tiles by equal shares of the pairs, about MOST_ROWS at most.

    Return the first tile of each group and the end, and the most pairs of a group. There is one
    group without `first_entry`.
    """
    tiles = frame.images * frame.tiles
    if first_entry is None:
        return [0, tiles], pairs
    groups, first = -(-pairs // MOST_ROWS), first_entry.read()
    shares = torch.arange(1, groups) * pairs // groups
    bounds = sorted({0, *torch.searchsorted(first, shares).tolist(), tiles})
    return bounds, int(first[bounds].diff().max())


def _rasterize_backward(
    frame: Frame,
    lists: TileLists,
    saved: SavedForBackward,
    arriving: tuple[Tensor, Tensor, Tensor | None],
    settings: RenderSettings,
    bounds: list[int],
    most: int,
) -> Float[Tensor, "splats channels"]:
    """Compute the gradients of the splats: those of their pairs, a group of tiles at a time.

    `arriving` are the gradients of image, transmittance and depth; for the groups, see
    `_group_tiles`. Without a depth, a splat's gradient has no last channel.
    """
    channels = GRADIENT.value - (settings.depth is None)
    rows = lists.splats.new_empty(most, channels)
    sums = lists.splats.new_empty(len(lists.splats), channels)
    grad_image, grad_transmittance, grad_depth = arriving
    for first, end in pairwise(bounds):
        rasterize_backward[(end - first,)](
            splats=lists.splats,
            entries=lists.entries,
            first_entry=lists.first_entry,
            **saved._asdict(),
            grad_image=grad_image,
            grad_transmittance=grad_transmittance,
            grad_depth=grad_depth,
            grads=rows,
            first_tile=first,
            **frame.grid,
            alpha_min=settings.limits.alpha_min,
            alpha_max=settings.limits.alpha_max,
            **_kinds(settings),
            STEP=BACKWARD_STEP,
            **RASTER_OPTIONS,
        )
        if len(sums):
            sum_pairs[(-(-len(sums) // SUM_BLOCK),)](
                counts=lists.counts,
                first_pair=lists.first_pair,
                places=lists.places,
                first_entry=lists.first_entry,
                grads=rows,
                sums=sums,
                num_splats=len(sums),
                first_tile=first,
                end_tile=end,
                CHANNELS=channels,
                BLOCK=SUM_BLOCK,
                **PROJECT_OPTIONS,
            )
    return sums


def _project_backward(
    frame: Frame,
    inputs: KernelInputs,
    counts: Tensor,
    splat_grads: Tensor,
    settings: RenderSettings,
    needs: dict[str, bool],
) -> KernelInputs:
    """Compute the gradients of the inputs from those of the splats; None where not required."""
    blocks, device = -(-frame.num // BACKWARD_BLOCK), counts.device
    shape = (frame.images, blocks, formulas.CAMERA_GRADIENT)
    one_view, sh = frame.views == 1, None
    if needs["SH_NEEDED"]:
        sh = torch.empty_like(inputs.sh) if one_view else torch.zeros_like(inputs.sh)
    cameras = None
    if needs["CAMERAS_NEEDED"]:
        cameras = torch.zeros(shape, dtype=torch.float64, device=device)
    grads = KernelInputs(*map(torch.empty_like, inputs[:4]), sh, cameras)
    if blocks:
        project_backward[(blocks, frame.images // frame.views)](
            **inputs._asdict(),
            counts=counts,
            grads=splat_grads,
            **{f"grad_{name}": grad for name, grad in grads._asdict().items()},
            num=frame.num,
            views=frame.views,
            eps2d=settings.limits.eps2d,
            compensation_min=settings.limits.compensation_min,
            ANTIALIASED=settings.antialiased,
            HAS_DEPTH=settings.depth is not None,
            **needs,
            ONE_VIEW=one_view,
            COUNT=frame.sh_count,
            BLOCK=BACKWARD_BLOCK,
            num_warps=BACKWARD_BLOCK // 32,
            **PROJECT_OPTIONS,
        )
    return grads


def _center_gradients(
    frame: Frame, counts: Tensor, splat_grads: Float[Tensor, "splats channels"]
) -> Float[Tensor, "B V N 2"]:
    """Return the gradients of the splats' centers, 0 where there is no splat."""
    grads = math.log(2) * splat_grads[:, :2].where(counts[:, None] > 0, 0.0)
    return grads.view(-1, frame.views, frame.num, 2)
