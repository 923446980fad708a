"""Folders with another system's renderings of the test views: names, sizes, what is refused."""

import re
import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from asysplat.data import ProceduralScene, SceneOptions, open_scene
from asysplat.data.selection import Selection
from asysplat.data.sources import Task
from asysplat.data.write import write_transforms
from asysplat.errors import InputError
from asysplat.evaluation.view_images import find_images, read_images, view_names

SIZE = (24, 32)
TARGETS = [1, 4]


@pytest.fixture(scope="module")
def task(tmp_path_factory) -> Task:
    """A scene on disk of 6 images, of which two are test views."""
    folder = tmp_path_factory.mktemp("data") / "room"
    write_transforms(ProceduralScene(3, *SIZE, num_images=6).views(range(6)), folder)
    return Task(open_scene(folder, SceneOptions(*SIZE)), Selection([0, 2, 5], TARGETS))


@pytest.fixture
def rendered(task, tmp_path) -> Path:
    """A folder with renderings of that scene: gray images, each as bright as its number."""
    (tmp_path / "other" / "room").mkdir(parents=True)
    for index in range(6):
        image = Image.new("RGB", SIZE[::-1], (index, index, index))
        image.save(tmp_path / "other" / "room" / f"{index:05d}.png")
    return tmp_path / "other"


def test_images_are_found_by_the_names_of_the_photographs(task, rendered):
    (rendered / "room" / "cameras.json").touch()  # files that are no images are ignored
    found = find_images(rendered, [task])
    assert [path.name for path in found["room"]] == ["00001.png", "00004.png"]
    images = read_images(found["room"], *SIZE)
    expected = torch.tensor(TARGETS).view(2, 1, 1, 1).expand(2, 3, *SIZE) / 255
    assert torch.equal(images.images, expected)
    drawn = images.render(task.sequence.cameras.select(TARGETS), torch.zeros(3))
    assert torch.equal(drawn.image, expected) and drawn.depth is None


def test_views_of_synthetic_scenes_are_numbered():
    sequence = ProceduralScene(3, *SIZE, num_images=6)
    assert view_names(Task(sequence, Selection([0], TARGETS))) == ["00001", "00004"]


DAMAGE = {
    "no image": (
        lambda room: (room / "00004.png").unlink(),
        "room has no image of 1 of the 2 test views, 00004: add one for each",
    ),
    "two of one name": (
        lambda room: shutil.copy(room / "00001.png", room / "00001.jpg"),
        "room has several images named 00001: remove all but one",
    ),
    "another scene": (
        lambda room: shutil.copytree(room, room.parent / "lego"),
        "has lego, named as no scene of the data: rename or remove; the scenes are room",
    ),
    "another size": (
        lambda room: Image.new("RGB", (32, 32)).save(room / "00004.png"),
        "00004.png is 32x32 (height x width), and the test views are 24x32: render at that size",
    ),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_folders_that_do_not_fit_the_data(task, rendered, case):
    damage, message = DAMAGE[case]
    damage(rendered / "room")
    with pytest.raises(InputError, match=re.escape(message)):
        read_images(find_images(rendered, [task])["room"], *SIZE)
