"""Files of disparities: where they lie, how they are written, whose photograph each belongs to."""

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

BESIDE = "disparities"  # the folder in a scene's own, where a user wants them there
LEVELS = 4095  # of a map: finer than any network is right, and PNG packs 12 bits well


def map_folder(scene: Path, cache: Path) -> Path:
    """Return the folder of a scene's maps in the cache, which knows scenes by their path."""
    return cache.expanduser() / f"{scene.name}-{_digest(str(scene.absolute()))}"


def map_name(image: ImageFile, scene: Path) -> str:
    """Return the file name of a photograph's map: of the photograph's place in its scene."""
    place = os.path.relpath(image, scene) if isinstance(image, Path) else str(image)
    return f"{Path(place).stem}-{_digest(place)}.png"


def with_disparities(posed: PosedScene, scene: Path, cache: Path) -> PosedScene:
    """Return the scene, its photographs with the maps that are there; as it was without any.

    Args:
        posed: as a reader returned it.
        scene: the path that was read.
        cache: where maps are kept; those in the scene's own folder come first.
    """
    found: dict[str, Path] = {}
    for folder in (map_folder(scene, cache), scene / BESIDE):
        if folder.is_dir():
            found |= {name: folder / name for name in os.listdir(folder)}
    if not found:
        return posed
    photographs = [
        replace(p, disparity=found.get(map_name(p.image, scene))) for p in posed.photographs
    ]
    return replace(posed, photographs=photographs)


def write_map(path: Path, disparity: Float[ndarray, "h w"]) -> None:
    """Write disparities as a 16-bit PNG: 1 for the least, LEVELS for the greatest.

    The loss sees no scale and no shift of a view, so none is kept; 0 stays free for what is not
    known. The file appears complete or not at all.

    Raises:
        InputError: NaN or infinity; a file that cannot be written.
    """
    if not np.isfinite(disparity).all():
        raise InputError(f"{path} would hold NaN or infinity: name another --model.")
    low, high = float(disparity.min()), float(disparity.max())
    share = (disparity - low) / max(high - low, np.finfo(np.float32).tiny)
    levels = (1 + np.round(share * (LEVELS - 1))).astype(np.uint16)
    with atomic_write(path) as partial:
        Image.fromarray(levels).save(partial)


def _digest(text: str) -> str:
    return blake2b(text.encode(), digest_size=8).hexdigest()
