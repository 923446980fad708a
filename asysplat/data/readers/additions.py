"""What is added to a scene that a reader has read: masks, and the faces of panoramas."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from asysplat.data.bad_images import BadImages
from asysplat.data.images import PANORAMA, Lens, has_alpha, load_alpha, same_proportions
from asysplat.data.readers.common import check_map_size
from asysplat.data.sequence import MasksOf, PosedImage, PosedScene
from asysplat.errors import InputError

MASKS = "masks"
FOLDERS = (MASKS, "mask", "images_mask")
REMOVE_BG = "-removebg-preview.png"  # what remove.bg adds to a name
DECIDING = 8  # masks, at most, that decide whether they are of an object
BORDER_SIDE = 64  # pixels to which a mask is shrunk to look at its border
MAX_KEPT = 0.1  # fraction of the border that most masks of an object keep


def with_masks(scene: PosedScene, bad: BadImages, masks: MasksOf = "auto") -> PosedScene:
    """Return a scene whose images have masks where there are any, see `find_mask`.

    Masks that the files of a scene name themselves stay. Errors of single images are collected.
    `masks` says whether they are of an object, and where they are 0 there is nothing, or what they
    leave out is to be ignored; "auto" and "find" take them for an object's if most leave out the
    borders. Transparent photographs are of an object.
    """

    def read(image: PosedImage) -> PosedImage:
        if image.mask is None and isinstance(image.file, Path):
            mask = find_mask(image.file)
            size = (image.lens.width, image.lens.height)
            image = replace(image, mask=mask and check_map_size(mask, size, str(image.file)))
        is_object = image.mask is not None and image.mask == image.file and masks != "ignore"
        return replace(image, is_object=is_object)

    images = bad.read_each(read, ((image,) for image in scene.images))
    separate = [i.mask for i in images if isinstance(i.mask, Path) and i.mask != i.file]
    if separate and masks != "ignore" and (masks == "object" or are_of_an_object(separate)):
        images = [replace(image, is_object=image.mask is not None) for image in images]
    return replace(scene, images=images)


def are_of_an_object(masks: Sequence[Path]) -> bool:
    """Return whether most masks leave out the borders, as those of an object in the middle do."""
    size, kept = (BORDER_SIDE, BORDER_SIDE), []
    for mask in masks[:: -(-len(masks) // DECIDING)]:
        pixels = np.asarray(Image.fromarray(load_alpha(mask)).resize(size)) > 127
        kept.append(np.mean([*pixels[[0, -1]].flat, *pixels[:, [0, -1]].flat]))
    return float(np.median(kept)) < MAX_KEPT


def find_mask(photograph: Path) -> Path | None:
    """Return the mask of a photograph; None without one.

    Of images/a/b.jpg it is masks/a/b.jpg.png (as COLMAP names it), masks/a/b.png (nerfstudio) or
    masks/a/b.jpg, and of b.jpg in a folder of another name it is in masks/ there; the folder may
    also be one of the other FOLDERS. Else it is the photograph itself, where that has an alpha
    channel.
    """
    folder, inner = photograph.parent, Path()
    images = next((f for f in (folder, folder.parent) if f.name.startswith("images")), None)
    if images is not None:
        folder, inner = images.parent, folder.relative_to(images)
    stem = photograph.stem
    names = (f"{photograph.name}.png", f"{stem}.png", photograph.name, f"{stem}{REMOVE_BG}")
    paths = (folder / masks / inner / name for masks in FOLDERS for name in names)
    if mask := next((path for path in paths if path.is_file()), None):
        return mask
    return photograph if has_alpha(photograph) else None


# Degrees to the right. Without the faces above and below: these show sky, and whatever carries the
# camera and moves with it; floor and ceiling there are seen from the side in other panoramas.
YAWS = (0.0, 90.0, 180.0, 270.0)


def panorama(width: int, height: int, where: str) -> Lens:
    """Return the lens of a whole panorama."""
    if not same_proportions((width, height), (2, 1)):
        raise InputError(
            f"{where} is {PANORAMA} and {width} x {height}: give panoramas of all directions, "
            "twice as wide as high."
        )
    fx, fy = width / (2 * math.pi), height / math.pi
    return Lens(width, height, fx, fy, cx=width / 2, cy=height / 2, model=PANORAMA)


def with_faces(scene: PosedScene, bad: BadImages) -> PosedScene:
    """Return a scene with four faces, each 90 degrees wide, in place of every panorama.

    They follow the other images: the first faces of all panoramas, then the second ones, and so on,
    so that consecutive images overlap. Errors of single panoramas are collected.
    """
    plain_images = [image for image in scene.images if image.lens.model != PANORAMA]
    panoramas = ((image,) for image in scene.images if image.lens.model == PANORAMA)
    sides = zip(*bad.read_each(_faces, panoramas), strict=True)
    return replace(scene, images=plain_images + [face for side in sides for face in side])


def _faces(image: PosedImage) -> list[PosedImage]:
    if image.depth is not None:
        raise InputError(
            f"{image.file} is a panorama with a depth map, and depths are along z: leave the "
            "depth map out."
        )
    side = math.ceil(2 * max(image.lens.fx, image.lens.fy))  # pixels as fine as at the equator
    square = replace(image.lens, width=side, height=side, cx=side / 2, cy=side / 2)
    faces = []
    for yaw in YAWS:
        lens, pose = replace(square, yaw=yaw), image.cam_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ lens.rotation
        faces.append(replace(image, lens=lens, cam_to_world=pose))
    return faces
