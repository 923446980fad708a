"""The loader of an epoch's tasks, which may start within the epoch."""

import signal
from typing import Any

import lightning
from torch.utils.data import DataLoader


class EpochLoader(DataLoader):
    """A loader whose length counts the batches that were `done` before, as Lightning does."""

    def __init__(self, done: int, *arguments: Any, **options: Any):
        self.done = done
        super().__init__(*arguments, **options)

    def __len__(self) -> int:
        return self.done + super().__len__()


def batches_done(trainer: lightning.Trainer) -> int:
    """Return how many batches of the epoch at hand came before the checkpoint that goes on."""
    loop = trainer.fit_loop
    began = loop.epoch_progress.current.ready > loop.epoch_progress.current.processed
    return loop.epoch_loop.batch_progress.current.completed if began else 0


def ignore_first_sigterm(_: int) -> None:
    """Ignore the first SIGTERM: a scheduler sends it to the loaders too, of a run that then saves.

    The second ends the process, so that it can be ended.
    """
    signal.signal(signal.SIGTERM, lambda *_: signal.signal(signal.SIGTERM, signal.SIG_DFL))
