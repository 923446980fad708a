"""Measure a scene's pixels and depth maps."""

from statistics import fmean

import torch
from rich.console import Console
from rich.progress import track

from asysplat.data.bad_images import BadImages
from asysplat.data.check.matches import Matches, epipolar_distances, triangulate
from asysplat.data.sequence import FileSequence, ImageSequence

MAX_EPIPOLAR_ERROR = 1.0  # pixels, of a match whose depth is compared
MIN_RAY_ANGLE = 1.5  # degrees between the rays of such a match


def read_pixels(
    sequence: FileSequence, bad: BadImages, console: Console | None
) -> tuple[FileSequence, dict[str, float]]:
    """Decode every image once; arguments and errors as for `check_scene`.

    Returns:
        The sequence without the damaged images; and the fraction of the pixels with a known depth
        under "depths", and of those that masks keep under "masks", where there are such files.
    """
    intact, fractions = [], {}
    images = sequence.scene.images
    bar = track(images, "decoding", console=console, transient=True, disable=console is None)
    for index, image in enumerate(bar):
        with bad.collect():
            views = sequence.views([index])
            intact.append(image)
            for name in ("depths", "masks"):
                if (values := getattr(views, name)) is not None:
                    fractions.setdefault(name, []).append(float((values > 0).double().mean()))
    bad.report(sequence.name, len(intact))
    means = {name: fmean(per_image) for name, per_image in fractions.items()}
    return sequence.with_images(intact), means


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
        stored = sequence.views([index]).depths
        assert stored is not None
        column, row = points[in_image].long().unbind(-1)
        ratios.append(stored[0].double()[row, column] / depths[in_image])
    known = torch.cat(ratios)
    known = known[known > 0]
    return float(known.median()), len(known)
