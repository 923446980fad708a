"""Monocular disparities of images: estimated once, kept on disk, read when present."""

import os
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import Image

from asysplat.data.images import ImageFile
from asysplat.data.sequence import PosedScene
from asysplat.errors import InputError
from asysplat.files import atomic_write

BESIDE = "disparities"  # the folder inside a scene's own folder, if a user puts maps there
LEVELS = 4095  # levels of a map: finer than any network's precision, and PNG packs 12 bits well


def map_folder(scene: Path, cache: Path) -> Path:
    """Return the folder of a scene's maps in the cache, named after the scene's path."""
    return cache.expanduser() / f"{scene.name}-{_digest(str(scene.absolute()))}"


def map_name(image: ImageFile, scene: Path) -> str:
    """Return the file name of an image's map, from the image's path inside its scene."""
    path = os.path.relpath(image, scene) if isinstance(image, Path) else str(image)
    return f"{Path(path).stem}-{_digest(path)}.png"


def with_disparities(posed: PosedScene, scene: Path, cache: Path) -> PosedScene:
    """Add the existing maps of `cache` to the images; those in the scene's own folder win."""
    maps: dict[str, Path] = {}
    for folder in (map_folder(scene, cache), scene / BESIDE):
        if folder.is_dir():
            maps |= {name: folder / name for name in os.listdir(folder)}
    if not maps:
        return posed
    images = [
        replace(image, disparity=maps.get(map_name(image.file, scene))) for image in posed.images
    ]
    return replace(posed, images=images)


def write_map(path: Path, disparity: Float[ndarray, "h w"]) -> None:
    """Write disparities as a 16-bit PNG: 1 for the least, LEVELS for the greatest.

    Scale and shift are not stored, since the loss ignores them; 0 means unknown.
    """
    if not np.isfinite(disparity).all():
        raise InputError(f"{path} would hold NaN or infinity: name another --model.")
    low, high = float(disparity.min()), float(disparity.max())
    fraction = (disparity - low) / max(high - low, np.finfo(np.float32).tiny)
    levels = (1 + np.round(fraction * (LEVELS - 1))).astype(np.uint16)
    with atomic_write(path) as partial:
        Image.fromarray(levels).save(partial)


def _digest(text: str) -> str:
    return blake2b(text.encode(), digest_size=8).hexdigest()
