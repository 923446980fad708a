"""Batches of reconstruction tasks, the same for the same seed wherever a run is resumed."""

from collections.abc import Callable, Mapping
from multiprocessing import get_all_start_methods
from typing import Any

import lightning
import numpy as np
from torch.utils.data import DataLoader, Dataset, Subset

from asysplat.data.normalise import normalise
from asysplat.data.sources import Source, Task
from asysplat.errors import InputError
from asysplat.scene import Views

Sample = dict[str, Any]  # scene: name, inputs: Views, targets: Views; a batch has lists of names


class SceneDataModule(lightning.LightningDataModule):
    """Training tasks drawn at random, evaluation tasks fixed.

    An epoch is the steps between two validations. Task i of a run is a pure function of the seed
    and i, and an epoch reads the tasks after those of the epochs before it.

    Args:
        name: the data set's name in metrics.
        source: where tasks come from.
        inputs, targets: views given and views to predict, per scene.
        height, width: of every view, in pixels; the source has made them so.
        batch_size: scenes per step.
        workers: processes that load ahead; 0 loads in the training process.
        seed: of the training tasks.
        steps_per_epoch: steps between two validations.
        test_sets: further test sets by name, each a function that makes its tasks.

    Raises:
        InputError: a task that cannot be loaded; the fixed ones are tried in `setup`.
    """

    def __init__(
        self,
        name: str,
        source: Source,
        inputs: int,
        targets: int,
        height: int,
        width: int,
        batch_size: int,
        workers: int,
        seed: int,
        steps_per_epoch: int,
        test_sets: Mapping[str, Callable[[], list[Task]]] | None = None,
    ):
        super().__init__()
        self.name, self.source = name, source
        self.inputs, self.targets = inputs, targets
        self.height, self.width = height, width
        self.batch_size, self.workers, self.seed = batch_size, workers, seed
        self.steps_per_epoch = steps_per_epoch
        self.test_sets = test_sets or {}
        self.evaluation: dict[str, list[Sample]] = {}  # val and test of this data set
        self.tests: dict[str, list[Sample]] = {}  # by test set, this data set first

    def setup(self, stage: str | None = None) -> None:
        """Load the validation and test tasks once, and try one training task."""
        if not self.evaluation:
            TrainingTasks(self)[0]
            for name in ("val", "test"):
                tasks = self.source.evaluation(name, self.inputs, self.targets)
                self.evaluation[name] = [load(task) for task in tasks]
            self.tests[self.name] = self.evaluation["test"]
            for name, make_tasks in self.test_sets.items():
                try:
                    self.tests[name] = [load(task) for task in make_tasks()]
                except InputError as error:
                    raise InputError(f"data.test_sets.{name}: {error}") from error

    def train_dataloader(self) -> DataLoader:
        per_epoch = self.steps_per_epoch * self.batch_size * self.trainer.world_size
        start = self.trainer.current_epoch * per_epoch
        epoch = Subset(TrainingTasks(self), range(start, start + per_epoch))
        return DataLoader(
            epoch,
            batch_size=self.batch_size,
            num_workers=self.workers,
            collate_fn=collate,
            prefetch_factor=4 if self.workers else None,
            # The platform's own: joblib's, the default in its jobs, cannot start these workers.
            multiprocessing_context=get_all_start_methods()[0] if self.workers else None,
        )

    def val_dataloader(self) -> DataLoader:
        return DataLoader(self.evaluation["val"], collate_fn=collate)

    def test_dataloader(self) -> list[DataLoader]:
        """One a test set, in the order of `tests`."""
        return [DataLoader(scenes, collate_fn=collate) for scenes in self.tests.values()]


class TrainingTasks(Dataset):
    """Task i, drawn with a generator of its own; there is no last one."""

    def __init__(self, data: SceneDataModule):
        self.source, self.seed = data.source, data.seed
        self.inputs, self.targets = data.inputs, data.targets

    def __getitem__(self, index: int) -> Sample:
        rng = np.random.default_rng((self.seed, index))
        return load(self.source.training(self.inputs, self.targets, rng))


def load(task: Task) -> Sample:
    """The task's views, validated and normalised."""
    frames = task.split.inputs + task.split.targets
    views = task.capture.views(frames).validate(task.capture.name)
    count = len(task.split.inputs)
    inputs, targets = views.select(range(count)), views.select(range(count, len(frames)))
    inputs, targets, _ = normalise(inputs, targets)
    return {"scene": task.capture.name, "inputs": inputs, "targets": targets}


def collate(samples: list[Sample]) -> Sample:
    return {
        "scene": [sample["scene"] for sample in samples],
        "inputs": Views.stack([sample["inputs"] for sample in samples]),
        "targets": Views.stack([sample["targets"] for sample in samples]),
    }
