"""Scenes on disk: which train and which test, opened when needed."""

import json

import numpy as np
import pytest

from asysplat.data import FilesSource, SceneOptions, sources
from asysplat.data.procedural import ProceduralScene
from asysplat.data.selection import Selection, held_out, kmeans_selection
from asysplat.errors import InputError

IMAGES = 24
SIZE = SceneOptions(8, 8)


@pytest.fixture
def opened(monkeypatch):
    """The names of the scenes that were opened, in order."""
    names = []

    def open_scene(path, *arguments, **options):
        names.append(path.name)
        return real(path, *arguments, **options)

    real = sources.open_scene
    monkeypatch.setattr(sources, "open_scene", open_scene)
    return names


def drawn(source, count=60, inputs=4, targets=2):
    rng = np.random.default_rng(0)
    return [source.training(inputs, targets, rng) for _ in range(count)]


def names(tasks):
    return {task.sequence.name for task in tasks}


def images(tasks):
    return {index for task in tasks for index in task.selection.inputs + task.selection.targets}


@pytest.mark.medium
def test_images_that_test_or_validate_are_not_trained_on(folder):
    source = FilesSource(folder("one", 3), SIZE, (12, 24))
    held = set(held_out(IMAGES, "test") + held_out(IMAGES, "val"))
    assert images(drawn(source)) == set(range(IMAGES)) - held


def test_folders_without_scenes_are_refused(tmp_path, written):
    with pytest.raises(InputError, match=r"data\.root"):
        FilesSource(str(tmp_path), SIZE, (12, 24))
    with pytest.raises(InputError, match=r"data\.test_root=.*nowhere"):
        FilesSource(str(written), SIZE, (12, 24), test_root=f"{tmp_path}/nowhere")


def test_scenes_are_opened_when_they_are_drawn(folder, opened):
    source = FilesSource(folder("many", *range(6)), SIZE, (12, 24), val_scenes=2)
    assert opened == []
    (task,) = drawn(source, 1)
    assert opened == [task.sequence.name]
    drawn(source)
    assert sorted(opened) == [f"s{seed}" for seed in range(6)]


def test_the_least_recently_used_scenes_are_closed(folder, opened, monkeypatch):
    monkeypatch.setattr(sources, "MAX_OPEN", 2)
    folder = sources.SceneFolder(folder("many", 0, 1, 2), SIZE)
    assert len(folder) == 3
    first = folder[0]
    assert folder[0] is first and folder[1].name == "s1" and folder[0] is first
    assert folder[2].name == "s2"  # closes s1
    assert folder[0] is first and folder[1].name == "s1"
    assert opened == ["s0", "s1", "s2", "s1"]


@pytest.mark.medium
def test_tested_scenes_are_not_trained_on(folder):
    """Although the root holds them too, in subfolders."""
    root, tested = folder("all/1K", *range(8)), folder("tested", 2, 5)
    source = FilesSource(root, SIZE, (12, 24), test_root=tested, val_scenes=2)
    validated = names(source.evaluation("val", 4, 2))
    assert names(source.evaluation("test", 4, 2)) == {"s2", "s5"}
    trained = names(drawn(source))
    assert len(validated) == 2 and len(trained) == 4
    assert trained | validated == {f"s{seed}" for seed in range(8)} - {"s2", "s5"}
    assert images(drawn(source)) == set(range(IMAGES))


def test_a_test_root_leaves_scenes_to_train_on(folder):
    root, tested = folder("all", 0, 1), folder("tested", 1)
    source = FilesSource(root, SIZE, (12, 24), test_root=tested, val_scenes=1)
    with pytest.raises(InputError, match=r"data\.val_scenes=1 leave no scene of data\.root=.*all"):
        drawn(source)


def test_the_selection_is_that_of_the_test_and_no_tested_image_is_trained_on(folder):
    root = folder("two", 3, 4)
    source = FilesSource(root, SIZE, (12, 24), selection="kmeans")
    for task in source.evaluation("test", 4, 2):
        cameras = ProceduralScene(int(task.sequence.name[1:]), 8, 8, IMAGES).cameras
        assert task.selection == kmeans_selection(cameras, 4, 2, "test")
        assert task.selection.targets == [0, 8, 16]
    assert not images(drawn(source)) & {0, 8, 16}
    with pytest.raises(InputError, match=r"data\.selection is 'k-means'"):
        FilesSource(root, SIZE, (12, 24), selection="k-means").evaluation("test", 4, 2)


@pytest.fixture
def index(tmp_path):
    """Write an index of pixelSplat's form and return its path."""

    def write(**scenes):
        file = tmp_path / "index.json"
        file.write_text(json.dumps(scenes))
        return str(file)

    return write


def test_an_index_names_the_scenes_and_frames_of_the_test(folder, index):
    file = index(s2={"context": [3, 20], "target": [3, 9]}, s5=None)
    source = FilesSource(
        *(folder("all", *range(8)), SIZE, (12, 24)),
        **{"test_root": folder("tested", 2, 5), "selection": "index", "index": file},
        val_scenes=2,
    )
    (task,) = source.evaluation("test", 2, 7)
    assert task.sequence.name == "s2" and task.selection == Selection([3, 20], [3, 9])
    assert len(source.evaluation("val", 2, 2)) == 2
    assert not names(drawn(source)) & {"s2", "s5"}


def test_an_index_that_does_not_fit_the_scenes_is_refused(folder, index):
    root = folder("one", 2)
    entry = {"context": [3, 20], "target": [9]}
    options = {"selection": "index", "index": index(s2=entry, s7=entry, s9=entry)}
    source = FilesSource(root, SIZE, (12, 24), **options)
    with pytest.raises(InputError, match=r"names 2 scenes that do not exist, such as s7"):
        source.evaluation("test", 2, 2)
    with pytest.raises(InputError, match=r"data\.selection=index would test images that are"):
        drawn(source)
    with pytest.raises(InputError, match=r"data\.selection is kmeans and data\.index is"):
        FilesSource(root, SIZE, (12, 24), **(options | {"selection": "kmeans"}))
    with pytest.raises(InputError, match=r"data\.on_error=skip changes the numbers"):
        FilesSource(root, SceneOptions(8, 8, on_error="skip"), (12, 24), **options)
