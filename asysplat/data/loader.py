"""The loader of an epoch's tasks, which may start within the epoch."""

import signal
from typing import Any

import lightning
from torch.utils.data import DataLoader


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
    """Ignore the first SIGTERM, which a scheduler also sends to the loaders of a run that saves.

    The second one ends the process.
    """
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL))
