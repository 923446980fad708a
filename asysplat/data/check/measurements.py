"""Measure a scene's pixels, camera path, sparse points and depth maps."""

from dataclasses import dataclass
from statistics import fmean as mean

import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from torch import Tensor

from asysplat.data.bad_images import BadImages
from asysplat.data.check.matches import Matches, epipolar_distances, triangulate
from asysplat.data.sequence import FileSequence, ImageSequence
from asysplat.scene import Cameras

DEPTH_STRIDE = 97  # one depth in so many is sampled; a prime, so that no pixel column is favored
POSE_TOLERANCE = 1e-6  # of equal poses: share of the path's extent, and entries of the rotation
MAX_EPIPOLAR_ERROR = 1.0  # pixels, of a match whose depth is compared
MIN_RAY_ANGLE = 1.5  # degrees between the rays of such a match

Quartiles = tuple[float, float, float]


@dataclass(frozen=True)
class PixelStats:
    """Statistics of all images that can be decoded.

    Args:
        brightness: mean colors, in [0, 1], of the darkest and of the brightest image.
        depth_known: share of the pixels whose depth is known; None without depth maps.
        depths: quartiles of those depths, in scene units.
        unmasked: share of the pixels that masks keep; None without masks.
    """

    brightness: tuple[float, float]
    depth_known: float | None
    depths: Quartiles | None
    unmasked: float | None


def read_pixels(
    sequence: FileSequence, bad: BadImages, console: Console | None
) -> tuple[FileSequence, PixelStats]:
    """Decode every image once, and return the sequence without the damaged images.

    Arguments and errors as for `check_scene`.
    """
    intact, brightness, known, unmasked, depths = [], [], [], [], []
    bar = {"console": console, "transient": True, "disable": console is None}
    for index, image in enumerate(track(sequence.scene.images, "decoding", **bar)):
        with bad.collect():
            views = sequence.views([index])
            intact.append(image)
            brightness.append(float(views.images.mean()))
            if views.depths is not None:
                known.append(float((views.depths > 0).double().mean()))
                depths.append(views.depths.flatten()[::DEPTH_STRIDE])
            if views.masks is not None:
                unmasked.append(float(views.masks.double().mean()))
    bad.report(sequence.name, len(intact))
    sampled = torch.cat(depths) if depths else torch.empty(0)
    return sequence.with_images(intact), PixelStats(
        brightness=(min(brightness), max(brightness)),
        depth_known=mean(known) if known else None,
        depths=quartiles(sampled[sampled > 0]),
        unmasked=mean(unmasked) if unmasked else None,
    )


def quartiles(values: Float[Tensor, " N"]) -> Quartiles | None:
    """Return the quartiles; None without values."""
    if not len(values):
        return None
    return tuple(values.double().quantile(torch.tensor([0.25, 0.5, 0.75]).double()).tolist())


@dataclass(frozen=True)
class CameraPath:
    """Lengths in scene units and angles in degrees; steps are from image to image.

    Args:
        length: of the whole path.
        extent: longest side of the box around all cameras.
        step, longest_step: median and greatest distance.
        turn, widest_turn: median and greatest rotation.
        repeated: number of images with the pose of an earlier image.
    """

    length: float
    extent: float
    step: float
    longest_step: float
    turn: float
    widest_turn: float
    repeated: int


def measure_path(cameras: Cameras) -> CameraPath:
    """Measure the path of the cameras, in the order of the images."""
    centers = cameras.centers.double()
    rotations = cameras.cam_to_world[:, :3, :3].double()
    steps = (centers[1:] - centers[:-1]).norm(dim=-1)
    # From the chord, since an arccosine is not precise for small angles.
    chords = (rotations[1:] - rotations[:-1]).flatten(1).norm(dim=-1)
    turns = torch.rad2deg(2 * torch.arcsin((chords / 8**0.5).clamp(max=1)))
    extent = (centers.amax(0) - centers.amin(0)).max()
    poses = torch.cat((centers / extent.clamp(min=1e-12), rotations.flatten(1)), 1)
    equal = torch.cdist(poses, poses, compute_mode="donot_use_mm_for_euclid_dist") < POSE_TOLERANCE
    return CameraPath(
        length=float(steps.sum()),
        extent=float(extent),
        step=float(steps.median()),
        longest_step=float(steps.max()),
        turn=float(turns.median()),
        widest_turn=float(turns.max()),
        repeated=int(equal.tril(-1).any(1).sum()),
    )


def count_points(cameras: Cameras, points: Float[Tensor, "P 3"]) -> tuple[float, float]:
    """Count the images that each point (float64) lies in, in front of the camera.

    Returns:
        The share of the points inside two images or more, and the median number of images.
    """
    views = torch.zeros(len(points), dtype=torch.int64)
    for view in range(cameras.num_views):
        _, _, inside = cameras.select([view]).to(torch.float64).project(points)
        views += inside[0]
    return float((views >= 2).double().mean()), float(views.double().median())


def compare_depths(sequence: ImageSequence, matches: Matches) -> tuple[Quartiles | None, int]:
    """Compare depth maps with precisely triangulated matches.

    Returns:
        Quartiles of stored over triangulated depths, and the number of points compared.
    """
    cameras = sequence.cameras.to(torch.float64)
    depths, angles = triangulate(cameras, matches)
    precise = (angles > MIN_RAY_ANGLE) & (depths > 0).all(-1)
    precise &= epipolar_distances(cameras, matches) < MAX_EPIPOLAR_ERROR
    indices, points, depths = (
        values[precise].flatten(0, 1) for values in (matches.indices, matches.points, depths)
    )
    ratios = [torch.empty(0, dtype=torch.float64)]
    for index in indices.unique().tolist():
        in_image = indices == index
        stored = sequence.views([index]).depths[0].double()
        column, row = points[in_image].long().unbind(-1)
        ratios.append(stored[row, column] / depths[in_image])
    known = torch.cat(ratios)
    known = known[known > 0]
    return quartiles(known), len(known)
