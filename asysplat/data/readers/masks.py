"""Find the masks of photographs: images in a folder beside theirs, or their own alpha."""

from dataclasses import replace
from pathlib import Path

from asysplat.data.bad_images import BadImages
from asysplat.data.images import has_alpha
from asysplat.data.readers.common import check_map_size
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.files import has_file

FOLDER = "masks"


def with_masks(scene: PosedScene, bad: BadImages) -> PosedScene:
    """Return a scene whose images have masks where there are any, see `find_mask`.

    Masks that the files of a scene name themselves stay. Errors of single images are collected.
    """

    def read(image: PosedImage) -> PosedImage:
        if image.mask is not None or not isinstance(image.file, Path):
            return image
        mask = find_mask(image.file)
        size = (image.lens.width, image.lens.height)
        return replace(image, mask=mask and check_map_size(mask, size, str(image.file)))

    return replace(scene, images=bad.read_each(read, ((image,) for image in scene.images)))


def find_mask(photograph: Path) -> Path | None:
    """Return the mask of a photograph, which is 0 where a pixel must be ignored; None without one.

    Of images/a/b.jpg it is masks/a/b.jpg.png (as COLMAP names it), masks/a/b.png (nerfstudio) or
    masks/a/b.jpg, and of b.jpg in a folder of another name it is in masks/ there; else it is the
    photograph itself, where that has an alpha channel.
    """
    folder = photograph.parent
    images = next((f for f in (folder, folder.parent) if f.name.startswith("images")), None)
    if images is None:
        masks = folder / FOLDER
    else:
        masks = images.parent / FOLDER / folder.relative_to(images)
    for name in (f"{photograph.name}.png", f"{photograph.stem}.png", photograph.name):
        if has_file(masks / name):
            return masks / name
    return photograph if has_alpha(photograph) else None
