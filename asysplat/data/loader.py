"""Which batches a process loads, and how its workers begin and end."""

import atexit
import signal
from dataclasses import dataclass
from multiprocessing import active_children
from typing import Any

import lightning
from torch.utils.data import DataLoader

from asysplat.errors import InputError


@dataclass(frozen=True)
class BatchSplit:
    """A global batch of `processes` x `micro_batch` x `accumulated` scenes."""

    processes: int
    micro_batch: int
    accumulated: int

    def __str__(self) -> str:
        total = self.processes * self.micro_batch * self.accumulated
        processes = f"{self.processes} process{'es' * (self.processes > 1)}"
        scenes = f"{self.micro_batch} scene{'s' * (self.micro_batch > 1)}"
        return f"global batch {total} = {processes} x {scenes} x {self.accumulated} accumulated"


def split_batch(batch_size: int, micro_batch: int | None, processes: int) -> BatchSplit:
    """Divide a global batch evenly; a process holds up to `micro_batch` of its scenes at a time."""
    scenes, remainder = divmod(batch_size, processes)
    if remainder:
        fewer = largest_divisor(batch_size, processes)
        raise InputError(
            f"data.batch_size={batch_size} scenes do not divide among {processes} processes "
            f"(trainer.devices x trainer.num_nodes): use {fewer} processes, or set "
            f"data.batch_size={processes * (scenes + 1)}."
        )
    largest = largest_divisor(scenes, micro_batch or scenes)
    return BatchSplit(processes, largest, scenes // largest)


def largest_divisor(number: int, limit: int) -> int:
    """Return the largest divisor of `number` up to `limit`."""
    return next(d for d in range(min(number, limit), 0, -1) if number % d == 0)


class EpochLoader(DataLoader):
    """A loader whose length includes the batches `done` before the checkpoint, as in Lightning."""

    def __init__(self, done: int, *arguments: Any, **options: Any):
        self.done = done
        super().__init__(*arguments, **options)

    def __len__(self) -> int:
        return self.done + super().__len__()


def batches_done(trainer: lightning.Trainer) -> int:
    """Return the number of batches of the current epoch before the checkpoint that is resumed."""
    loop = trainer.fit_loop
    epochs = loop.epoch_progress.current
    # Annotation of Lightning: the class that has it inherits from the annotated one.
    began = epochs.ready > epochs.processed  # ty: ignore[missing-attribute]
    return loop.epoch_loop.batch_progress.current.completed if began else 0


def ignore_first_sigterm(_: int) -> None:
    """Ignore the first SIGTERM, which a scheduler also sends to the loaders of a run that saves."""
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL))


@atexit.register
def kill_loaders() -> None:
    """Kill workers that a failed run left: Python sends them one SIGTERM, and waits."""
    for process in active_children():
        if process.daemon:
            process.kill()
