"""Sources of tasks: which sequences train, validate and test, and which of their images."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from asysplat.data.procedural import ProceduralScene, split_seed
from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.selection import (
    Selection,
    Split,
    evenly_spaced,
    grown_window,
    named_selection,
    training_images,
    training_selection,
    uniform_selection,
)
from asysplat.data.selection.index import read_index, select_from_index
from asysplat.data.sequence import FileSequence, ImageSequence, SceneOptions
from asysplat.errors import InputError

MAX_OPEN = 64  # scenes of a folder


@dataclass(frozen=True)
class Task:
    """A sequence, with the indices of the input images and of the images to predict."""

    sequence: ImageSequence
    selection: Selection
    prune: bool = True  # in a model that prunes its Gaussians


@runtime_checkable
class Source(Protocol):
    """Where the data module gets its tasks."""

    def training(
        self, inputs: int, targets: int, rng: np.random.Generator, grown: float = 1.0
    ) -> Task:
        """Draw a random training task; the same state of `rng` gives the same task.

        `grown` is the fraction, in [0, 1], by which the window has grown from its first size.
        """

    def evaluation(self, split: Split, inputs: int, targets: int) -> list[Task]:
        """Return the fixed tasks of a split; no task trains on any of their targets."""


@dataclass(frozen=True)
class ProceduralSource:
    """Synthetic scenes: unlimited ones to train, and fixed ones to validate and test."""

    height: int
    width: int
    num_images: int
    window: Sequence[int] | None
    val_scenes: int
    test_scenes: int
    places: str = "both"
    varied: bool = False  # in training; see ProceduralScene
    first_window: Sequence[int] | None = None

    def training(
        self, inputs: int, targets: int, rng: np.random.Generator, grown: float = 1.0
    ) -> Task:
        scene = self._scene("train", int(rng.integers(2**31)))
        window = grown_window(self.first_window, self.window, grown)
        return Task(scene, training_selection(self.num_images, inputs, targets, window, rng))

    def evaluation(self, split: Split, inputs: int, targets: int) -> list[Task]:
        selection = uniform_selection(self.num_images, inputs, targets)
        count = self.val_scenes if split == "val" else self.test_scenes
        return [Task(self._scene(split, index), selection) for index in range(count)]

    def _scene(self, split: Literal["train", "val", "test"], index: int) -> ProceduralScene:
        size, varied = (self.height, self.width, self.num_images), self.varied and split == "train"
        return ProceduralScene(split_seed(split, index), *size, places=self.places, varied=varied)


class SceneFolder:
    """The scenes that a folder is or holds, of which the MAX_OPEN last used stay open."""

    def __init__(self, root: str, options: SceneOptions):
        self.root = Path(root).absolute()
        layout, self.paths = find_scenes(root, options.layout)
        self._options = replace(options, layout=layout)
        self._open: dict[int, FileSequence] = {}

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> FileSequence:
        sequence = self._open.pop(index, None) or open_scene(self.paths[index], self._options)
        self._open[index] = sequence  # the last used is the last
        if len(self._open) > MAX_OPEN:
            del self._open[next(iter(self._open))]
        return sequence

    def __iter__(self) -> Iterator[FileSequence]:
        return (self[index] for index in range(len(self)))

    def folders(self, index: int) -> set[str]:
        """Return the folder names between the root and a scene, and its own, without opening it."""
        path = self.paths[index]
        return {*path.parts} - {*self.root.parts} | {path.name}


@dataclass(eq=False)
class FilesSource:
    """Scenes on disk.

    With a `test_root`, its scenes test, some scenes of `root` validate, and the others train with
    all their images; test scenes are never trained on, even if `root` holds them as well. Without a
    `test_root`, in every scene of `root` the first of every 8 images tests, the fifth validates,
    and the others train. Of scenes whose data set holds out images, every_8th tests those, and the
    fifth of every 8 others validates.
    """

    root: str  # one scene, or a folder of scenes, as test_root
    options: SceneOptions
    # Least and greatest number of consecutive images that a training task is drawn from; None: all.
    window: Sequence[int] | None
    test_root: str | None = None
    scenes: Sequence[str] | None = None  # names of the folders that test; None: all
    # every_8th, kmeans (the paper's tests), first_96 (its ablations), uniform, or index
    selection: str = "every_8th"
    # With selection=index, the file that names images. Other scenes are not tested, and validation
    # takes every_8th.
    index: str | None = None
    val_scenes: int = 8
    targets_may_be_inputs: bool = False  # in training
    first_window: Sequence[int] | None = None  # window of the first task; None: `window`

    def __post_init__(self):
        self.split_by_scenes = self.test_root is not None
        folders = []
        for key in ("root", "test_root") if self.split_by_scenes else ("root",):
            root = getattr(self, key)
            try:
                folders.append(SceneFolder(root, self.options))
            except InputError as error:
                raise InputError(f"data.{key}={root}: {error}") from error
        self.training_folder, self.test_folder = folders[0], folders[-1]
        if (self.selection == "index") != (self.index is not None):
            raise InputError(
                f"data.selection is {self.selection} and data.index is {self.index}: give both "
                "data.selection=index and data.index=path, or neither."
            )
        if self.selection == "index" and self.options.on_error == "skip":
            raise InputError(
                "data.on_error=skip changes the numbers of the images that data.index names: "
                "set it to fail, and fix the images."
            )

    def training(
        self, inputs: int, targets: int, rng: np.random.Generator, grown: float = 1.0
    ) -> Task:
        _, scenes = self._split
        if not self.split_by_scenes and self.selection in ("uniform", "index"):
            raise InputError(
                f"data.selection={self.selection} would test images that are trained on: name the "
                "scenes to test with data.test_root, or use every_8th, kmeans or first_96."
            )
        if not scenes:
            raise InputError(
                f"data.test_root and data.val_scenes={self.val_scenes} leave no scene of "
                f"data.root={self.root} to train on: give more scenes, or validate fewer."
            )
        sequence = self.training_folder[scenes[rng.integers(len(scenes))]]
        count = sequence.num_images
        published = sequence.scene.held_out if self.selection == "every_8th" else ()
        images = range(count) if self.split_by_scenes else training_images(count, published)
        window = grown_window(self.first_window, self.window, grown)
        both = self.targets_may_be_inputs
        drawn = training_selection(len(images), inputs, targets, window, rng, both)
        chosen = Selection([images[i] for i in drawn.inputs], [images[i] for i in drawn.targets])
        return Task(sequence, chosen)

    def evaluation(self, split: Split, inputs: int, targets: int) -> list[Task]:
        if split == "test" and self.index is not None:
            return self._index_tasks(self.index, inputs)
        selection = "every_8th" if self.selection == "index" else self.selection
        validated = (self.training_folder[scene] for scene in self._split[0])
        options = inputs, targets, split
        return [
            Task(scene, named_selection(selection, scene.cameras, *options, scene.scene.held_out))
            for scene in (self._tests if split == "test" else validated)
        ]

    @cached_property
    def _tests(self) -> list[FileSequence]:
        folder, scenes = self.test_folder, self.scenes
        if scenes is None:
            return list(folder)
        named = [folder.folders(index) & {*scenes} for index in range(len(folder))]
        if missing := {*scenes} - set().union(*named):
            raise InputError(
                f"scenes names {min(missing)}, and {folder.root} has no such folder: choose of "
                f"{', '.join(path.name for path in folder.paths)}."
            )
        return [folder[index] for index, names in enumerate(named) if names]

    @cached_property
    def _split(self) -> tuple[list[int], list[int]]:
        """The scenes of `root` that validate, and those that train; no tested scene does."""
        scenes = list(range(len(self.training_folder)))
        if self.split_by_scenes:
            tested = self._tests if self.scenes is None else self.test_folder
            names = {sequence.name for sequence in tested}
            folders = self.training_folder.folders
            scenes = [scene for scene in scenes if names.isdisjoint(folders(scene))]
        validated = evenly_spaced(scenes, min(self.val_scenes, len(scenes)))
        return validated, sorted({*scenes} - {*validated}) if self.split_by_scenes else scenes

    def _index_tasks(self, file: str, inputs: int) -> list[Task]:
        index = read_index(file, inputs)
        tasks = [
            Task(scene, select_from_index(index, file, scene.name, scene.num_images, inputs))
            for scene in self._tests
            if scene.name in index
        ]
        if not tasks:
            raise InputError(
                f"data.index={file} names none of the scenes of {self.test_folder.root}, "
                f"such as {self._tests[0].name}: give the index of this data set."
            )
        if missing := set(index) - {task.sequence.name for task in tasks}:
            raise InputError(
                f"data.index={file} names {len(missing)} scenes that do not exist, such as "
                f"{min(missing)}: add them, or write an index of the scenes that you have with "
                "python -m asysplat.data.selection."
            )
        return tasks


def tested_sets(test_sets: Mapping[str, Any] | None, name: str, on_disk: bool) -> dict[str, Any]:
    """Choose the further test sets of a configuration that a run tests.

    One with a root of its own is tested only by data on disk, if the root is given and the set has
    another name than the data.
    """
    return {
        test_set: options
        for test_set, options in (test_sets or {}).items()
        if not has_root(options) or (on_disk and options["root"] is not None and test_set != name)
    }


def has_root(options: Any) -> bool:
    return isinstance(options, Mapping) and "root" in options
