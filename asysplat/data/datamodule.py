"""Batches of tasks: the same for the same seed, wherever a run is resumed."""

import re
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import current_process, get_all_start_methods
from typing import NotRequired, TypedDict

import lightning
import numpy as np
import torch
from rich.markup import escape
from rich.progress import track
from torch.utils.data import DataLoader, Dataset, Subset

from asysplat.data import loader
from asysplat.data.augment import Augmentation, center_crop
from asysplat.data.bad_images import Policy
from asysplat.data.normalize import Normalization, normalize
from asysplat.data.selection import Selection
from asysplat.data.sequence import FileSequence
from asysplat.data.sources import Source, Task
from asysplat.errors import InputError
from asysplat.scene import Views

MAX_DRAWS = 10  # scenes drawn for one task, with on_error=skip
MAX_LOADED_BYTES = 2**28  # size of the images of fixed tasks that a process keeps in memory


class Sample(TypedDict):
    """The views of one task; see `load` and `TrainingTasks`."""

    scene: str
    inputs: Views
    targets: Views
    prune: NotRequired[bool]
    frame: NotRequired[Normalization]
    bad_scenes: NotRequired[list[str]]


class Batch(TypedDict):
    """Samples of several scenes, stacked."""

    scene: list[str]
    inputs: Views
    targets: Views
    prune: bool
    bad_scenes: list[str]


@dataclass(eq=False, repr=False)
class SceneDataModule(lightning.LightningDataModule):
    """Lightning's data module of tasks: random for training, fixed for evaluation.

    An epoch is the steps between two validations. Task i of a run depends only on the seed and i,
    and an epoch continues where the previous one ended. The tasks of a step, and the scenes of an
    evaluation, go to processes round-robin: Lightning needs use_distributed_sampler=False.

    Args:
        name: the data set's name in metrics.
        inputs, targets: number of input views and of views to predict, per scene.
        height, width: size in pixels of every view from `source`; test sets may have another.
        batch_size: scenes of an optimizer step, of all processes together.
        num_workers: number of processes that load ahead; 0 loads in the training process.
        seed: seed of the training tasks.
        test_sets: further test sets by name, each a function that returns its tasks; one with the
            data set's name replaces the source's test.
        augmentation: random changes of training tasks; None changes nothing.
        on_error: where a training scene cannot be used, "fail", or "skip" to draw another; a
            batch's `bad_scenes` lists the errors.
        micro_batch: the most scenes that a process holds at a time; None: all of its scenes.
        growth_steps: optimizer steps in which the window of the training tasks grows.
        prefetch: batches that each of the `num_workers` holds ready.

    Raises:
        InputError: a name that no file can have, or a task that cannot be loaded: `setup` tries one
            training task, and all of the fixed ones that are kept in memory.
    """

    # Without Lightning's default, which is None.
    name: str = field()  # ty: ignore[incompatible-mutable-override]
    source: Source
    inputs: int
    targets: int
    height: int
    width: int
    batch_size: int
    num_workers: int
    seed: int
    steps_per_epoch: int
    test_sets: Mapping[str, Callable[[], list[Task]]] = field(default_factory=dict)
    augmentation: Augmentation | None = None
    on_error: Policy = "fail"
    micro_batch: int | None = None
    growth_steps: int = 0
    prefetch: int = 2

    def __post_init__(self):
        super().__init__()
        self.evaluation: dict[str, FixedTasks] = {}  # val and test of this data set
        self.tests: dict[str, FixedTasks] = {}  # by test set, this data set first
        for name in (self.name, *self.test_sets):
            # Files of results are named by them, and keys, whose parts a slash separates.
            if not (isinstance(name, str) and re.fullmatch(r"\w[^/\\\0\n]{0,99}", name)):
                raise InputError(
                    f"data.name or a key of data.test_sets is {name!r:.200}: give at most "
                    "100 characters without slashes, the first a letter or a digit."
                )

    def setup(self, stage: str | None = None) -> None:
        """Load the validation and test tasks, and try one training task."""
        if not self.evaluation:
            counts = (self.inputs, self.targets)
            # All images are selected before any is read, since an index may not fit the scenes.
            main_set = partial(self.source.evaluation, "test", *counts)
            tests: dict[str, list[Task]] = {}
            for name, make_tasks in {self.name: main_set, **self.test_sets}.items():
                with self._naming(name):
                    tests[name] = make_tasks()
            validation = self.source.evaluation("val", *counts)
            TrainingTasks(self)[0]  # raises where it cannot be read
            room = MAX_LOADED_BYTES
            self.evaluation["val"] = FixedTasks(validation, "validation", room, self._process)
            room -= self.evaluation["val"].num_bytes
            for name, tasks in tests.items():
                with self._naming(name):
                    self.tests[name] = FixedTasks(tasks, f"test {name}", room, self._process)
                room -= self.tests[name].num_bytes
            self.evaluation["test"] = self.tests[self.name]

    @contextmanager
    def _naming(self, test_set: str, main: str | None = None) -> Generator[None]:
        """Name a test set in the InputErrors of the body; the data set's own only as `main`."""
        try:
            yield
        except InputError as error:
            where = main if test_set == self.name else f"data.test_sets.{test_set}"
            if where is None:
                raise
            raise InputError(f"{where}: {error}") from error

    def check_sizes(self, check: Callable[[int, int], None]) -> None:
        """Call `check(height, width)` for every set; its InputError names the set."""
        check(self.height, self.width)
        for name, tasks in self.tests.items():
            with self._naming(name, "data.test_size"):
                check(*tasks[0]["inputs"].images.shape[-2:])

    def check_views(self, check: Callable[[int], None]) -> None:
        """Call `check(inputs)` for every set; its InputError names the set."""
        check(self.inputs)
        for name, tasks in self.tests.items():
            with self._naming(name):
                check(tasks[0]["inputs"].num_views)

    def split(self, processes: int) -> loader.BatchSplit:
        """Divide the scenes of an optimizer step among processes."""
        return loader.split_batch(self.batch_size, self.micro_batch, processes)

    @property
    def _process(self) -> tuple[int, int]:
        trainer = self.trainer
        return (0, 1) if trainer is None else (trainer.global_rank, trainer.world_size)

    def train_dataloader(self) -> DataLoader:
        trainer, count = self.trainer, self.steps_per_epoch * self.batch_size
        assert trainer is not None  # it is the caller
        return self.tasks(trainer.current_epoch * count, count, loader.batches_done(trainer))

    def tasks(self, start: int, count: int, done: int = 0) -> DataLoader:
        """Return this process's micro-batches of `count` tasks from `start` on, after `done`.

        A step has the same tasks for any number of processes.
        """
        rank, processes = self._process
        micro_batch = self.split(processes).micro_batch
        first = start + rank + done * micro_batch * processes
        tasks = Subset(TrainingTasks(self), range(first, start + count, processes))
        return loader.EpochLoader(
            done,
            tasks,
            batch_size=micro_batch,
            num_workers=self.num_workers,
            collate_fn=collate,
            prefetch_factor=self.prefetch if self.num_workers else None,
            # The platform's default: inside a joblib job the default is joblib's, which cannot
            # start these workers.
            multiprocessing_context=get_all_start_methods()[0] if self.num_workers else None,
            worker_init_fn=loader.ignore_first_sigterm,
            # Starting a loader draws from its generator, and a resumed run starts one more.
            generator=torch.Generator(),
        )

    def val_dataloader(self) -> DataLoader:
        return self._evaluation_loader(self.evaluation["val"])

    def test_dataloader(self) -> list[DataLoader]:
        """Return one loader per test set, in the order of `tests`."""
        return [self._evaluation_loader(scenes) for scenes in self.tests.values()]

    def _evaluation_loader(self, scenes: "FixedTasks") -> DataLoader:
        """Return this process's scenes, one per batch; one with fewer scenes repeats its last."""
        # Processes with unequally many batches would wait for each other.
        rank, processes = self._process
        last = max(range(rank, len(scenes), processes), default=0)
        indices = [min(first + rank, last) for first in range(0, len(scenes), processes)]
        return DataLoader(Subset(scenes, indices), collate_fn=collate)


class TrainingTasks(Dataset):
    """An endless list of training tasks; task i is drawn with its own generator."""

    def __init__(self, data: SceneDataModule):
        self.source, self.seed = data.source, data.seed
        self.augmentation = data.augmentation or Augmentation()
        self.inputs, self.targets = data.inputs, data.targets
        self.draws = MAX_DRAWS if data.on_error == "skip" else 1
        self.growing_tasks = data.growth_steps * data.batch_size

    def __getitem__(self, index: int) -> Sample:
        errors: list[str] = []
        while True:
            # (seed, index, 0) gives what (seed, index) gives.
            rng = np.random.default_rng((self.seed, index, len(errors)))
            try:
                return {**self._sample(rng, index), "bad_scenes": errors}
            except (InputError, OSError) as error:
                errors.append(str(error).partition("\n")[0])
                if len(errors) == self.draws:
                    row = f"{MAX_DRAWS} training scenes in a row cannot be used, the last because "
                    raise InputError(f"{row if self.draws > 1 else ''}{error}") from error

    def _sample(self, rng: np.random.Generator, index: int) -> Sample:
        grown = min(1.0, index / self.growing_tasks) if self.growing_tasks else 1.0
        task = self.source.training(self.inputs, self.targets, rng, grown)
        inputs = self.augmentation.order(task.selection.inputs, rng)
        crop = self.augmentation.draw_crop(rng)
        task = Task(task.sequence, Selection(inputs, task.selection.targets))
        sample = load(task, crop)
        inputs, targets = self.augmentation.expose(sample["inputs"], sample["targets"], rng)
        return {"scene": sample["scene"], "inputs": inputs, "targets": targets}


class FixedTasks(Dataset):
    """Evaluation tasks.

    The first ones of a process, (rank, processes), are loaded into memory: images of up to `room`
    bytes, and those of one task more.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        name: str = "",
        room: int | float = MAX_LOADED_BYTES,
        process: tuple[int, int] = (0, 1),
    ):
        self.tasks, self.num_bytes = tasks, 0
        self._loaded: dict[int, Sample] = {}
        (rank, processes), title = process, escape(f"loading {name}")
        # Processes side by side would draw over each other.
        alone = rank == 0 and current_process().name == "MainProcess"
        mine = range(rank, len(tasks), processes)
        for index in track(mine, title, transient=True, disable=not alone):
            if self.num_bytes > room:
                break
            self._loaded[index] = sample = load(tasks[index])
            self.num_bytes += sum(sample[each].images.nbytes for each in ("inputs", "targets"))

    def __len__(self) -> int:
        return len(self.tasks)

    def __getitem__(self, index: int) -> Sample:
        sample = self._loaded.get(index) or load(self.tasks[index])
        inputs, targets = sample["inputs"].decoded(), sample["targets"].decoded()
        return {**sample, "inputs": inputs, "targets": targets}


def load(task: Task, crop: float = 1.0) -> Sample:
    """Read a task's views, with images as stored, validate, crop and normalize them.

    The sample's `frame` is the Normalization.
    """
    inputs, targets = task.selection.inputs, task.selection.targets
    # An image that is both input and target is decoded once.
    indices = list(dict.fromkeys(inputs + targets))
    sequence = task.sequence
    read = sequence.stored if isinstance(sequence, FileSequence) else sequence.views
    views = center_crop(read(indices).validate(sequence.name), crop)
    inputs, targets = (
        views.select([indices.index(index) for index in chosen]) for chosen in (inputs, targets)
    )
    inputs, targets, frame = normalize(inputs, targets)
    return {
        "scene": sequence.name,
        "prune": task.prune,
        "inputs": inputs,
        "targets": targets,
        "frame": frame,
    }


def collate(samples: list[Sample]) -> Batch:
    return {
        "scene": [sample["scene"] for sample in samples],
        "inputs": Views.stack([sample["inputs"] for sample in samples]),
        "targets": Views.stack([sample["targets"] for sample in samples]),
        "prune": all(sample.get("prune", True) for sample in samples),
        "bad_scenes": [error for sample in samples for error in sample.get("bad_scenes", ())],
    }
