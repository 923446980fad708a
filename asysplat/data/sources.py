"""Sources of tasks: which sequences train, validate and test, and which of their frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from asysplat.data.bad_images import Policy
from asysplat.data.cache import ImageCache
from asysplat.data.procedural import ProceduralScene, split_seed
from asysplat.data.scene_folder import SceneFolder
from asysplat.data.selection import (
    Selection,
    Split,
    named_selection,
    spread,
    training_frames,
    training_selection,
    uniform_selection,
)
from asysplat.data.selection.index import read_index
from asysplat.data.sequence import FileSequence, ImageSequence
from asysplat.errors import InputError


@dataclass(frozen=True)
class Task:
    """One reconstruction: the frames of a sequence that are given and those to predict."""

    sequence: ImageSequence
    selection: Selection


@runtime_checkable
class Source(Protocol):
    """Where the data module gets its tasks."""

    def training(self, inputs: int, targets: int, rng: np.random.Generator) -> Task:
        """Draw a random training task; the same state of `rng` gives the same task."""
        ...

    def evaluation(self, split: Split, inputs: int, targets: int) -> list[Task]:
        """Return the fixed tasks of a split; none of their targets is ever trained on."""
        ...


class ProceduralSource:
    """Synthetic scenes: endless ones to train, and fixed ones to validate and test.

    No seed is used in two splits.

    Args:
        height, width: size of every view, in pixels.
        num_frames: length of each camera path.
        window: least and greatest number of consecutive frames that a training task is drawn from.
        val_scenes, test_scenes: how many scenes each split has.
        places: what the scenes show: both, rooms or outdoors.
        varied: whether scenes that train are varied ones; see ProceduralScene.
    """

    def __init__(
        self,
        height: int,
        width: int,
        num_frames: int,
        window: Sequence[int],
        val_scenes: int,
        test_scenes: int,
        places: str = "both",
        varied: bool = False,
    ):
        self.height, self.width, self.num_frames = height, width, num_frames
        self.places, self.varied = places, varied
        self.window = (window[0], window[1])
        self.counts = {"val": val_scenes, "test": test_scenes}

    def training(self, inputs: int, targets: int, rng: np.random.Generator) -> Task:
        scene = self._scene("train", int(rng.integers(2**31)))
        return Task(scene, training_selection(self.num_frames, inputs, targets, self.window, rng))

    def evaluation(self, split: Split, inputs: int, targets: int) -> list[Task]:
        selection = uniform_selection(self.num_frames, inputs, targets)
        return [Task(self._scene(split, index), selection) for index in range(self.counts[split])]

    def _scene(self, split: Literal["train", "val", "test"], index: int) -> ProceduralScene:
        return ProceduralScene(
            split_seed(split, index),
            self.height,
            self.width,
            self.num_frames,
            places=self.places,
            varied=self.varied and split == "train",
        )


class FilesSource:
    """Scenes on disk.

    With a `test_root`, splits are made by scenes: those of `test_root` test, some scenes of `root`
    validate, and the others train with all their frames. A scene that is tested is never trained
    on, even if `root` holds it as well. Without a `test_root`, splits are made by frames: in every
    scene of `root`, the first of every 8 frames tests, the fifth validates, the others train.

    Args:
        root: one scene, or a folder of scenes.
        height, width: size of every view, in pixels.
        window: as for ProceduralSource.
        layout, on_bad_image, cache, disparities: as `open_scene` takes them.
        test_root: one scene, or a folder of scenes.
        selection: how the frames of a test are chosen: every_8th, kmeans (the paper's tests),
            first_96 (its ablations), uniform, or index.
        index: with selection=index, the file that names the frames; scenes that it does not name
            are not tested, and validation takes every_8th.
        val_scenes: greatest number of scenes that validate.
        targets_may_be_inputs: whether a training task's targets may be among its inputs.

    Raises:
        InputError: no scene, an index that does not fit, or options that do not go together; and,
            when a scene is first used, files that cannot be used.
    """

    def __init__(
        self,
        root: str,
        height: int,
        width: int,
        window: Sequence[int],
        layout: str = "auto",
        on_bad_image: Policy = "fail",
        cache: ImageCache | None = None,
        disparities: str | None = None,
        test_root: str | None = None,
        selection: str = "every_8th",
        index: str | None = None,
        val_scenes: int = 8,
        targets_may_be_inputs: bool = False,
    ):
        def scenes(option: str, folder: str) -> SceneFolder:
            try:
                return SceneFolder(folder, height, width, layout, on_bad_image, cache, disparities)
            except InputError as error:
                raise InputError(f"data.{option}={folder}: {error}") from error

        self.window = (window[0], window[1])
        self.selection, self.index = selection, index
        self.targets_may_be_inputs = targets_may_be_inputs
        self.scenes = scenes("root", root)
        self.split_by_scenes = test_root is not None
        self.tested = scenes("test_root", test_root) if self.split_by_scenes else self.scenes
        self.val_scenes = val_scenes
        if (selection == "index") != (index is not None):
            raise InputError(
                f"data.selection is {selection} and data.index is {index}: give both "
                "data.selection=index and data.index=path, or neither."
            )
        if selection == "index" and on_bad_image == "skip":
            raise InputError(
                "data.on_bad_image=skip changes the numbers of the frames that data.index names: "
                "set it to fail, and fix the frames."
            )

    def training(self, inputs: int, targets: int, rng: np.random.Generator) -> Task:
        sequence = self.scenes[self._trained[rng.integers(len(self._trained))]]
        frames = (
            range(sequence.num_frames)
            if self.split_by_scenes
            else training_frames(sequence.num_frames)
        )
        drawn = training_selection(
            len(frames), inputs, targets, self.window, rng, self.targets_may_be_inputs
        )
        chosen = Selection([frames[i] for i in drawn.inputs], [frames[i] for i in drawn.targets])
        return Task(sequence, chosen)

    def evaluation(self, split: Split, inputs: int, targets: int) -> list[Task]:
        if split == "test" and self.selection == "index":
            return self._indexed(inputs)
        selection = "every_8th" if self.selection == "index" else self.selection
        validated = (self.scenes[scene] for scene in self._validated)
        return [
            Task(sequence, named_selection(selection, sequence.cameras, inputs, targets, split))
            for sequence in (self._tested if split == "test" else validated)
        ]

    @cached_property
    def _tested(self) -> list[FileSequence]:
        return list(self.tested)

    @cached_property
    def _untested(self) -> list[int]:
        """The scenes of `root` that may train and validate."""
        scenes = range(len(self.scenes))
        if not self.split_by_scenes:
            return list(scenes)
        names = {sequence.name for sequence in self._tested}
        return [scene for scene in scenes if names.isdisjoint(self.scenes.folders(scene))]

    @cached_property
    def _validated(self) -> list[int]:
        return spread(self._untested, min(self.val_scenes, len(self._untested)))

    @cached_property
    def _trained(self) -> list[int]:
        if not self.split_by_scenes and self.selection in ("uniform", "index"):
            raise InputError(
                f"data.selection={self.selection} would test frames that are trained on: name the "
                "scenes to test with data.test_root, or use every_8th, kmeans or first_96."
            )
        if not self.split_by_scenes:
            return self._untested
        left = sorted(set(self._untested) - set(self._validated))
        if not left:
            raise InputError(
                f"data.root has {len(self._untested)} scenes that data.test_root does not test, "
                f"and data.val_scenes is {self.val_scenes}: give more scenes, or validate fewer."
            )
        return left

    def _indexed(self, inputs: int) -> list[Task]:
        index = read_index(self.index, inputs)
        tasks = [
            Task(sequence, index.selection(sequence.name, sequence.cameras, inputs))
            for sequence in self._tested
            if sequence.name in index.entries
        ]
        lacking = set(index.entries) - {task.sequence.name for task in tasks}
        if lacking:
            raise InputError(
                f"data.index={self.index} names {len(lacking)} scenes that are not there, such as "
                f"{min(lacking)}: add them, or write an index of the scenes that you have with "
                "python -m asysplat.data.selection."
            )
        return tasks
