"""Division of an optimizer step's scenes: among processes, then into micro-batches."""

from dataclasses import dataclass

from asysplat.errors import InputError


@dataclass(frozen=True)
class BatchSplit:
    """A global batch of `processes` x `micro_batch` x `accumulated` scenes.

    Args:
        processes: number of processes that train together, on all nodes.
        micro_batch: scenes that a process holds at a time.
        accumulated: micro-batches whose gradients make an optimizer step.
    """

    processes: int
    micro_batch: int
    accumulated: int

    def __str__(self) -> str:
        total = self.processes * self.micro_batch * self.accumulated
        processes = f"{self.processes} process{'es' * (self.processes > 1)}"
        scenes = f"{self.micro_batch} scene{'s' * (self.micro_batch > 1)}"
        return f"global batch {total} = {processes} x {scenes} x {self.accumulated} accumulated"


def split_batch(batch_size: int, micro_batch: int | None, processes: int) -> BatchSplit:
    """Divide a global batch evenly.

    Args:
        batch_size: scenes of an optimizer step.
        micro_batch: the most scenes that a process may hold at a time; fewer where these do not
            divide its scenes; None: all of its scenes.
        processes: number of processes that train together.
    """
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
