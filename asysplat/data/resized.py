"""Photographs in the smaller sizes in which their data set ships them.

Mip-NeRF 360 and LLFF have copies of `images` in `images_2`, `images_4` and `images_8`. Numbers
published on these, and on copies that are made of the large photographs and lack the artifacts of a
second JPEG, differ by .27 dB: https://github.com/nerfstudio-project/gsplat/pull/507
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from asysplat.data.images import image_size
from asysplat.data.readers.common import images_in, scale_lens
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

FOLDERS = ("images_2", "images_4", "images_8")


def as_published(scene: PosedScene, height: int, width: int) -> tuple[PosedScene, str | None]:
    """Return the scene with copies of this size as its photographs, and the name of their folder.

    Without such copies, the scene as it is, and None; so where photographs lie in several folders
    or inside other files, or are distorted: then they are resampled anyway.
    """
    files = [image.file for image in scene.images if isinstance(image.file, Path)]
    distorted = any(image.lens.is_distorted for image in scene.images)
    if distorted or len(files) < len(scene.images) or len({file.parent for file in files}) != 1:
        return scene, None
    for name in FOLDERS:
        copies = _copies(files, files[0].parent.parent / name)
        if copies and image_size(copies[0]) == (width, height):
            pairs = zip(scene.images, copies, strict=True)
            images = [_as_copy(image, copy, (width, height)) for image, copy in pairs]
            return replace(scene, images=images), name
    return scene, None


def _copies(photographs: Sequence[Path], folder: Path) -> list[Path]:
    """Find the copies by their names, or by their order if all names differ; none if one lacks."""
    originals, copies = images_in(photographs[0].parent), images_in(folder)
    stems, by_stem = [path.stem for path in photographs], {copy.stem: copy for copy in copies}
    if by_stem.keys().isdisjoint(stems) and len(originals) == len(copies):
        # LLFF has images_4/image000.png of images/IMG_4026.JPG.
        by_stem = {path.stem: copy for path, copy in zip(originals, copies, strict=True)}
    return [by_stem[stem] for stem in stems] if by_stem.keys() >= {*stems} else []


def _as_copy(image: PosedImage, copy: Path, size: tuple[int, int]) -> PosedImage:
    if (found := image_size(copy)) != size:
        raise InputError(
            f"{copy} is {found[0]} x {found[1]} and others in its folder {size[0]} x {size[1]}: "
            "copy the folder again as it was published."
        )
    mask = copy if image.mask == image.file else image.mask  # where it is transparent
    return replace(image, file=copy, lens=scale_lens(image.lens, size, str(copy)), mask=mask)
