"""Where scenes come from: which captures train, validate and test, and which of their frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from asysplat.data.bad_frames import Policy
from asysplat.data.cache import ImageCache
from asysplat.data.capture import Capture
from asysplat.data.procedural import ProceduralScene, split_seed
from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.selection import (
    Split,
    evaluation_split,
    held_out_split,
    trained,
    training_split,
)
from asysplat.errors import InputError


@dataclass(frozen=True)
class Task:
    """One reconstruction: the frames of a capture that are given and those to predict."""

    capture: Capture
    split: Split


@runtime_checkable
class Source(Protocol):
    """What the data module draws from."""

    def training(self, inputs: int, targets: int, rng: np.random.Generator) -> Task:
        """A random training task; the same generator gives the same task."""
        ...

    def evaluation(self, stage: Literal["val", "test"], inputs: int, targets: int) -> list[Task]:
        """The fixed tasks of a stage, none of whose target frames was ever trained on."""
        ...


class ProceduralSource:
    """Endless training scenes, and validation and test scenes whose seeds never meet them.

    Args:
        height, width: of every view, in pixels.
        num_frames: length of each camera path.
        window: how many consecutive frames a training task is drawn from, least and most.
        val_scenes, test_scenes: how many scenes each stage has.
        places: both, rooms or outdoors: of every scene.
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
    ):
        self.height, self.width, self.num_frames = height, width, num_frames
        self.places = places
        self.window = (window[0], window[1])
        self.counts = {"val": val_scenes, "test": test_scenes}

    def training(self, inputs: int, targets: int, rng: np.random.Generator) -> Task:
        scene = self._scene("train", int(rng.integers(2**31)))
        return Task(scene, training_split(self.num_frames, inputs, targets, self.window, rng))

    def evaluation(self, stage: Literal["val", "test"], inputs: int, targets: int) -> list[Task]:
        split = evaluation_split(self.num_frames, inputs, targets)
        return [Task(self._scene(stage, index), split) for index in range(self.counts[stage])]

    def _scene(self, split: Literal["train", "val", "test"], index: int) -> ProceduralScene:
        seed = split_seed(split, index)
        return ProceduralScene(seed, self.height, self.width, self.num_frames, places=self.places)


class FilesSource:
    """Scenes on disk. Of every 8 frames the first is tested and the fifth validates; the others are
    given as inputs and trained on.

    Args:
        root: one scene, or a folder of scenes.
        height, width: of every view, in pixels.
        window: as for ProceduralSource.
        layout, on_bad_frame, cache: as `open_scene` takes them.

    Raises:
        InputError: no scene, or one that cannot be used.
    """

    def __init__(
        self,
        root: str,
        height: int,
        width: int,
        window: Sequence[int],
        layout: str = "auto",
        on_bad_frame: Policy = "fail",
        cache: ImageCache | None = None,
    ):
        self.window = (window[0], window[1])
        try:
            layout, scenes = find_scenes(root, layout)
        except InputError as error:
            raise InputError(f"data.root={root}: {error}") from error
        self.captures = [
            open_scene(scene, height, width, layout, on_bad_frame, cache) for scene in scenes
        ]

    def training(self, inputs: int, targets: int, rng: np.random.Generator) -> Task:
        capture = self.captures[rng.integers(len(self.captures))]
        frames = trained(capture.num_frames)
        split = training_split(len(frames), inputs, targets, self.window, rng)
        return Task(
            capture, Split([frames[i] for i in split.inputs], [frames[i] for i in split.targets])
        )

    def evaluation(self, stage: Literal["val", "test"], inputs: int, targets: int) -> list[Task]:
        return [
            Task(capture, held_out_split(capture.num_frames, inputs, targets, stage))
            for capture in self.captures
        ]
