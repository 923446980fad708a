from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from asysplat.data.images import EncodedImage, Lens
from asysplat.data.resized import as_published
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

LENS = Lens(46, 30, 40.0, 42.0, 23.0, 14.0)


def save(folder, names, width, height):
    folder.mkdir(parents=True)
    for name in names:
        Image.new("RGB", (width, height)).save(folder / name)


@pytest.fixture
def scene(tmp_path):
    """Photographs of 46 x 30, of which the second is not in the scene, and no copies."""
    save(tmp_path / "images", ("a7.JPG", "b1.JPG", "c3.JPG"), 46, 30)
    files = (tmp_path / "images" / name for name in ("c3.JPG", "a7.JPG"))
    return PosedScene("desk", [PosedImage(file, LENS, np.eye(4)) for file in files])


def names_of(scene):
    return [f"{image.file.parent.name}/{image.file.name}" for image in scene.images]


def test_copies_of_the_size_are_found_by_their_names(scene, tmp_path):
    save(tmp_path / "images_2", ("a7.JPG", "b1.JPG", "c3.JPG"), 23, 15)
    save(tmp_path / "images_4", ("a7.png", "c3.png", "d.png"), 12, 8)
    half, folder = as_published(scene, 15, 23)
    assert (folder, names_of(half)) == ("images_2", ["images_2/c3.JPG", "images_2/a7.JPG"])
    assert half.images[0].lens == Lens(23, 15, 20.0, 21.0, 11.5, 7.0)
    fourth, folder = as_published(scene, 8, 12)
    assert (folder, names_of(fourth)) == ("images_4", ["images_4/c3.png", "images_4/a7.png"])
    x, y = 12 / 46, 8 / 30  # rounded sides
    assert fourth.images[1].lens == Lens(12, 8, 40 * x, 42 * y, 23 * x, 14 * y)


def test_copies_of_other_names_are_found_by_their_order(scene, tmp_path):
    save(tmp_path / "images_2", ("image000.png", "image001.png", "image002.png"), 23, 15)
    published, _ = as_published(scene, 15, 23)
    assert names_of(published) == ["images_2/image002.png", "images_2/image000.png"]


@pytest.mark.parametrize(
    "names, width",
    [
        (("a7.JPG", "c3.JPG"), 22),
        (("image000.png", "image001.png"), 23),
        (("a7.JPG", "b1.JPG"), 23),
    ],
    ids=["other size", "other count", "one lacks"],
)
def test_without_such_copies_a_scene_is_unchanged(scene, tmp_path, names, width):
    save(tmp_path / "images_2", names, width, 15)
    assert as_published(scene, 15, 23) == (scene, None)


def test_images_that_are_distorted_or_inside_other_files_are_unchanged(scene, tmp_path):
    save(tmp_path / "images_2", ("a7.JPG", "c3.JPG"), 23, 15)
    first, second = scene.images
    lens = replace(LENS, model="OPENCV", distortion=(0.1, 0.0, 0.0, 0.0))
    encoded = EncodedImage("chunk, frame 0", bytes)
    for other in (replace(first, lens=lens), replace(first, file=encoded)):
        changed = replace(scene, images=[other, second])
        assert as_published(changed, 15, 23) == (changed, None)


def test_a_mask_in_the_photograph_is_the_copy_s(scene, tmp_path):
    save(tmp_path / "images_2", ("a7.JPG", "c3.JPG"), 23, 15)
    first, second = scene.images
    masks = [replace(first, mask=first.file), replace(second, mask=tmp_path / "masks/a7.png")]
    published, _ = as_published(replace(scene, images=masks), 15, 23)
    expected = [tmp_path / "images_2/c3.JPG", tmp_path / "masks/a7.png"]
    assert [image.mask for image in published.images] == expected


def test_copies_of_several_sizes_are_refused(scene, tmp_path):
    save(tmp_path / "images_2", ("a7.JPG", "c3.JPG"), 23, 15)
    Image.new("RGB", (15, 23)).save(tmp_path / "images_2/a7.JPG")
    with pytest.raises(InputError, match=r"images_2/a7\.JPG is 15 x 23 and others .* 23 x 15"):
        as_published(scene, 15, 23)
