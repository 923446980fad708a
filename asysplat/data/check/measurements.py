"""Measure a scene's pixels, camera path, sparse points and depth maps."""

from statistics import fmean

import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from torch import Tensor

from asysplat.data.bad_images import BadImages
from asysplat.data.check.matches import Matches, epipolar_distances, triangulate
from asysplat.data.sequence import FileSequence, ImageSequence
from asysplat.scene import Cameras

POSE_TOLERANCE = 1e-6  # of equal poses: share of the path's extent, and entries of the rotation
MAX_EPIPOLAR_ERROR = 1.0  # pixels, of a match whose depth is compared
MIN_RAY_ANGLE = 1.5  # degrees between the rays of such a match


def read_pixels(
    sequence: FileSequence, bad: BadImages, console: Console | None
) -> tuple[FileSequence, dict[str, float]]:
    """Decode every image once; arguments and errors as for `check_scene`.

    Returns:
        The sequence without the damaged images; and the share of the pixels with a known depth
        under "depths", and of those that masks keep under "masks", where there are such files.
    """
    intact, shares = [], {}
    bar = {"console": console, "transient": True, "disable": console is None}
    for index, image in enumerate(track(sequence.scene.images, "decoding", **bar)):
        with bad.collect():
            views = sequence.views([index])
            intact.append(image)
            for name in ("depths", "masks"):
                if (values := getattr(views, name)) is not None:
                    shares.setdefault(name, []).append(float((values > 0).double().mean()))
    bad.report(sequence.name, len(intact))
    return sequence.with_images(intact), {name: fmean(each) for name, each in shares.items()}


def measure_path(
    cameras: Cameras,
) -> tuple[float, Float[Tensor, " steps"], Float[Tensor, " steps"], int]:
    """Measure the path of the cameras, in the order of the images.

    Returns:
        The longest side of the box around all cameras, and the distance from image to image, in
        scene units; the rotation from image to image, in degrees; and the number of images with the
        pose of an earlier image.
    """
    centers = cameras.centers.double()
    rotations = cameras.cam_to_world[:, :3, :3].double()
    # From the chord, since an arccosine is not precise for small angles.
    chords = (rotations[1:] - rotations[:-1]).flatten(1).norm(dim=-1)
    turns = torch.rad2deg(2 * torch.arcsin((chords / 8**0.5).clamp(max=1)))
    extent = (centers.amax(0) - centers.amin(0)).max()
    poses = torch.cat((centers / extent.clamp(min=1e-12), rotations.flatten(1)), 1)
    equal = torch.cdist(poses, poses, compute_mode="donot_use_mm_for_euclid_dist") < POSE_TOLERANCE
    repeated = int(equal.tril(-1).any(1).sum())
    return float(extent), (centers[1:] - centers[:-1]).norm(dim=-1), turns, repeated


def shared_points(cameras: Cameras, points: Float[Tensor, "P 3"]) -> float:
    """Return the share of points (float64) inside two images or more, in front of the cameras."""
    views = torch.zeros(len(points), dtype=torch.int64)
    for view in range(cameras.num_views):
        _, _, inside = cameras.select([view]).to(torch.float64).project(points)
        views += inside[0]
    return float((views >= 2).double().mean())


def compare_depths(sequence: ImageSequence, matches: Matches) -> tuple[float, int]:
    """Compare depth maps with precisely triangulated matches.

    Returns:
        The median of stored over triangulated depths, and the number of points compared.
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
    return float(known.median()), len(known)
