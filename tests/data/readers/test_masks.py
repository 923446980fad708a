"""Masks beside the images, and alpha."""

import numpy as np
import pytest
import torch
from layouts import assert_listed, assert_same, opener
from layouts import transforms as layout
from PIL import Image

from asysplat.errors import InputError

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


def make_transparent(image, alpha):
    pixels = np.asarray(Image.open(image))
    Image.fromarray(np.dstack([pixels, (255 * alpha.numpy()).astype(np.uint8)])).save(image)


def test_alpha_is_transparency(few, tmp_path):
    folder = layout.write(few, tmp_path)
    alpha = half().float()
    alpha[:, 20] = 0.4
    make_transparent(folder / "images" / "00002.png", alpha)
    views = opened(folder).views(range(4)).validate()
    assert views.masks is None and (views.alphas[[0, 1, 3]] == 1).all()
    torch.testing.assert_close(views.alphas[2], alpha)
    on_white = alpha * few.images[2].float() + 1 - alpha
    torch.testing.assert_close(views.images[2], on_white, rtol=0, atol=1 / 255)
    green = torch.tensor([0.0, 1.0, 0.0])
    on_green = alpha * few.images[2].float() + (1 - alpha) * green[:, None, None]
    found = views.over(torch.ones(3), green).images[2]
    torch.testing.assert_close(found, on_green, rtol=0, atol=1 / 255)
    masks = opened(folder, masks="ignore").views(range(4)).masks
    assert torch.equal(masks[2], alpha == 1) and masks[[0, 1, 3]].all()


def middle(height=24, width=32):
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[4:-4, 4:-4] = True
    return mask


def test_masks_that_leave_out_the_borders_are_of_an_object(few, tmp_path):
    folder = layout.write(few, tmp_path)
    for index in range(4):
        save(middle(12, 16), folder / "mask" / f"{index:05d}.png")  # half the size
    views = opened(folder).views(range(4))
    assert views.masks is None and (views.alphas[:, 12, 16] > 0.9).all()
    assert (views.images[views.alphas[:, None].expand(-1, 3, -1, -1) == 0] == 1).all()
    ignored = opened(folder, masks="ignore").views(range(4))
    assert ignored.alphas is None and not ignored.masks[:, 0].any()
    assert_same(ignored.images, few.images)


def test_masks_of_what_to_ignore_may_be_said_to_be_of_an_object(few, tmp_path):
    folder = layout.write(few, tmp_path)
    save(half(), folder / "masks" / "00001.png")
    alphas = opened(folder, masks="object").views(range(4)).alphas
    assert torch.equal(alphas[1] == 1, half()) and (alphas[[0, 2, 3]] == 1).all()


@pytest.mark.parametrize("mode", ["LA", "P", "PA", "I;16"])
def test_other_kinds_of_alpha_are_read_or_named(few, tmp_path, mode):
    folder = layout.write(few, tmp_path)
    image = folder / "images" / "00000.png"
    make_transparent(image, half().float())
    if mode == "I;16":
        Image.new(mode, (32, 24)).save(image)
        with pytest.raises(InputError, match="save it as 8-bit RGB"):
            opened(folder).views([0])
        return
    Image.open(image).convert(mode).save(image, format="tiff" if mode == "PA" else "png")
    alphas = opened(folder).views([0]).alphas
    assert torch.equal(alphas[0] == 1, half()) or mode == "P"  # a palette has one color for each


@pytest.mark.parametrize("name", ["masks/00001.png", "images/00001.png"])
def test_a_damaged_alpha_is_named(few, tmp_path, name):
    folder = layout.write(few, tmp_path)
    if name.startswith("masks"):
        save(half(), folder / name)
    else:
        make_transparent(folder / name, half().float())
    (folder / name).write_bytes((folder / name).read_bytes()[:60])
    with pytest.raises(InputError, match=rf"{name} cannot be read as an image .*: copy it again"):
        opened(folder).views([1])


def test_a_mask_of_other_proportions_is_named(few, tmp_path):
    folder = layout.write(few, tmp_path)
    save(half(24, 24), folder / "masks" / "00003.png")
    assert_listed(opened, folder, "masks/00003.png is 24 x 24 and the image 32 x 24")
