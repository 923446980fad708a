"""Masks beside the images, and alpha."""

import numpy as np
import pytest
import torch
from layouts import assert_listed, opener
from layouts import transforms as layout
from PIL import Image

opened = opener("transforms")


def half(height=24, width=32):
    """Everything but the left half is kept."""
    mask = torch.ones(height, width, dtype=torch.bool)
    mask[:, : width // 2] = False
    return mask


def save(mask, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask.numpy()).convert("L").save(path)


@pytest.mark.parametrize("name", ["00001.png.png", "00001.png"])
def test_masks_beside_the_images(few, tmp_path, name):
    folder = layout.write(few, tmp_path)
    assert opened(folder).views([0]).masks is None
    save(half(), folder / "masks" / name)
    masks = opened(folder).views(range(4)).masks
    assert torch.equal(masks[1], half()) and masks[[0, 2, 3]].all()


def test_masks_of_images_in_folders(few, tmp_path):
    folder = layout.write(few, tmp_path)
    (folder / "images" / "left").mkdir()
    for name in ("00001.png", "00002.png"):
        (folder / "images" / name).rename(folder / "images" / "left" / name)
        file = folder / "transforms.json"
        file.write_text(file.read_text().replace(f"images/{name}", f"images/left/{name}"))
    save(half(), folder / "masks" / "left" / "00001.png")
    save(half(), folder / "masks" / "00002.png")  # another image's
    sequence = opened(folder)
    names = [image.file.stem for image in sequence.scene.images]
    masks = dict(zip(names, sequence.views(range(4)).masks, strict=True))
    assert torch.equal(masks.pop("00001"), half())
    assert all(mask.all() for mask in masks.values())


def test_a_mask_that_the_scene_names_is_used(few, tmp_path):
    folder = layout.write(few, tmp_path)
    save(~half(), folder / "own.png")
    save(half(), folder / "masks" / "00001.png")
    file = folder / "transforms.json"
    name = '"file_path": "images/00001.png"'
    file.write_text(file.read_text().replace(name, f'{name}, "mask_path": "own.png"'))
    assert torch.equal(opened(folder).views([1]).masks[0], ~half())


def test_alpha_is_a_mask(few, tmp_path):
    folder = layout.write(few, tmp_path)
    image = folder / "images" / "00002.png"
    pixels = np.asarray(Image.open(image))
    alpha = np.where(half().numpy(), 255, 0).astype(np.uint8)
    alpha[:, 20] = 254  # what is a little transparent has a color that is mixed with white
    Image.fromarray(np.dstack([pixels, alpha])).save(image)
    views = opened(folder).views(range(4))
    expected = half()
    expected[:, 20] = False
    assert torch.equal(views.masks[2], expected) and views.masks[[0, 1, 3]].all()
    kept = expected.expand(3, -1, -1)
    assert torch.equal(views.images[2][kept], few.images[2].float()[kept])


def test_a_mask_of_other_proportions_is_named(few, tmp_path):
    folder = layout.write(few, tmp_path)
    save(half(24, 24), folder / "masks" / "00003.png")
    assert_listed(opened, folder, "masks/00003.png is 24 x 24 and the image 32 x 24")
