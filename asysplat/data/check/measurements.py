"""What is measured of a scene: its pixels, its camera path, its sparse points, its depth maps."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.data.bad_images import BadFrames
from asysplat.data.sequence import ImageSequence, FileSequence
from asysplat.data.check.matches import Matches, epipolar_distances, triangulate
from asysplat.scene import Cameras

SAMPLED = 97  # one depth in so many is looked at; a prime, so that no pixel column is favored
SAME = 1e-6  # poses differ by less: as a share of the path's extent, and in a rotation's entries
PRECISE = 1.0  # pixels: greatest distance to the epipolar line of a match that is triangulated
WIDE = 1.5  # degrees: least angle between its rays

Quartiles = tuple[float, float, float]


@dataclass(frozen=True)
class Pixels:
    """What the pixels of all frames that can be decoded show.

    Args:
        brightness: mean colors, in [0, 1], of the darkest and of the brightest image.
        depth_known: share of the pixels whose depth is known; None without depth maps.
        depths: quartiles of those depths, in scene units.
        counted: share of the pixels that count; None without masks.
    """

    brightness: tuple[float, float]
    depth_known: float | None
    depths: Quartiles | None
    counted: float | None


def read_pixels(
    sequence: FileSequence, bad: BadFrames, step: Callable[[], None] = lambda: None
) -> tuple[FileSequence, Pixels]:
    """Decode every frame once.

    Args:
        bad: notes the frames that cannot be decoded; the sequence that is returned lacks them.
        step: called after each frame.

    Raises:
        InputError: too few frames can be used, or some cannot and must not be skipped.
    """
    whole, brightness, known, counted, depths = [], [], [], [], []
    for frame, photograph in enumerate(sequence.scene.photographs):
        with bad.caught():
            views = sequence.views([frame])
            whole.append(photograph)
            brightness.append(float(views.images.mean()))
            if views.depths is not None:
                known.append(float((views.depths > 0).double().mean()))
                depths.append(views.depths.flatten()[::SAMPLED])
            if views.masks is not None:
                counted.append(float(views.masks.double().mean()))
        step()
    bad.settle(sequence.name, len(whole))
    scene = replace(sequence.scene, photographs=whole)
    sampled = torch.cat(depths) if depths else torch.empty(0)
    return FileSequence(scene, sequence.cameras.height, sequence.cameras.width), Pixels(
        brightness=(min(brightness), max(brightness)),
        depth_known=_mean(known),
        depths=quartiles(sampled[sampled > 0]),
        counted=_mean(counted),
    )


def quartiles(values: Float[Tensor, " N"]) -> Quartiles | None:
    """Return the quartiles; None of no values."""
    if not len(values):
        return None
    low, middle, high = values.double().quantile(values.new_tensor([0.25, 0.5, 0.75]).double())
    return float(low), float(middle), float(high)


def _mean(shares: list[float]) -> float | None:
    return sum(shares) / len(shares) if shares else None


@dataclass(frozen=True)
class CameraPath:
    """The camera path: lengths in scene units, angles in degrees; steps are frame to frame.

    Args:
        length: of the whole path.
        extent: the longest side of the box around all cameras.
        step, longest_step: distance from a frame to the next, median and greatest.
        turn, widest_turn: rotation from a frame to the next, median and greatest.
        repeated: frames whose pose is that of an earlier frame.
    """

    length: float
    extent: float
    step: float
    longest_step: float
    turn: float
    widest_turn: float
    repeated: int


@dataclass(frozen=True)
class PointsSeen:
    """How many sparse points there are, and how many views should show them.

    Args:
        count: how many there are.
        seen: share that lies in front of two cameras or more and inside their images.
        views: number of images in which a point lies, in the median.
    """

    count: int
    seen: float
    views: float


def measure_path(cameras: Cameras) -> CameraPath:
    """Measure the path of the cameras of all frames, in order."""
    centers = cameras.centers.double()
    rotations = cameras.cam_to_world[:, :3, :3].double()
    steps = (centers[1:] - centers[:-1]).norm(dim=-1)
    # From the chord, since an arccosine is not precise for small angles.
    chords = (rotations[1:] - rotations[:-1]).flatten(1).norm(dim=-1)
    turns = torch.rad2deg(2 * torch.arcsin((chords / 8**0.5).clamp(max=1)))
    extent = (centers.amax(0) - centers.amin(0)).max()
    poses = torch.cat((centers / extent.clamp(min=1e-12), rotations.flatten(1)), 1)
    same = torch.cdist(poses, poses, compute_mode="donot_use_mm_for_euclid_dist") < SAME
    return CameraPath(
        length=float(steps.sum()),
        extent=float(extent),
        step=float(steps.median()),
        longest_step=float(steps.max()),
        turn=float(turns.median()),
        widest_turn=float(turns.max()),
        repeated=int(same.tril(-1).any(1).sum()),
    )


def count_points(cameras: Cameras, points: Float[Tensor, "P 3"]) -> PointsSeen:
    """Count in how many images each point (float64) lies."""
    views = torch.zeros(len(points), dtype=torch.int64)
    size = torch.tensor([cameras.width, cameras.height])
    poses, lenses = cameras.cam_to_world.double(), cameras.intrinsics.double()
    for pose, lens in zip(poses, lenses, strict=True):
        in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels = in_camera @ lens[:2].T / in_camera[:, 2:]
        views += ((pixels >= 0) & (pixels <= size)).all(-1) & (in_camera[:, 2] > 0)
    return PointsSeen(
        count=len(points),
        seen=float((views >= 2).double().mean()),
        views=float(views.double().median()),
    )


@dataclass(frozen=True)
class DepthScale:
    """Quartiles of depth maps over triangulated depths, and the number of points compared."""

    ratios: Quartiles
    points: int


def compare_depths(sequence: ImageSequence, matches: Matches) -> DepthScale | None:
    """Compare depth maps with the depths of matches that are triangulated precisely.

    None if no depth is known at any of these.
    """
    cameras = sequence.cameras.to(torch.float64)
    depths, angles = triangulate(cameras, matches)
    sure = (angles > WIDE) & (epipolar_distances(cameras, matches) < PRECISE) & (depths > 0).all(-1)
    ratios = [torch.empty(0, dtype=torch.float64)]
    frames, points, depths = (
        x[sure].flatten(0, 1) for x in (matches.frames, matches.points, depths)
    )
    for frame in frames.unique().tolist():
        here = frames == frame
        stored = sequence.views([frame]).depths[0].double()
        column, row = points[here].long().unbind(-1)
        ratios.append(stored[row, column] / depths[here])
    ratios = torch.cat(ratios)
    known = ratios[ratios > 0]
    return DepthScale(quartiles(known), len(known)) if len(known) else None
