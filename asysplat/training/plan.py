"""Try a micro-batch before the first step: the memory, time and disk that a training needs."""

import math
import shutil
from datetime import timedelta
from pathlib import Path

import lightning
import torch

from asysplat.data.datamodule import TrainingTasks, collate
from asysplat.errors import InputError
from asysplat.evaluation.cost import GB, count_parameters, memory_gb
from asysplat.evaluation.measured_cost import CostMeter
from asysplat.training.module import SplattingModule
from asysplat.training.sharded import ShardedStrategy

MOMENT_BYTES = 8  # of a parameter: AdamW's two moments, which the trial has not
SAVED_BYTES = 12  # of a parameter in a checkpoint, which has no gradients
CHECKPOINTS = 3  # best, last, and one that is being written


def plan_lines(
    parameters: int,
    steps: int,
    memory: float,
    capacity: float,
    seconds: float,
    disk: float,
    free: float,
) -> str:
    """Write what a training needs; memory and disk in GB, seconds of a step's micro-batches."""
    time = timedelta(seconds=round(steps * seconds))
    return (
        f"plan: {parameters / 1e6:.2f}M parameters, {steps:,} steps\n"
        f"  memory: about {memory:.3g} of {capacity:.3g} GB\n"
        f"  time: {seconds:.3g} s a step, {time} without validation\n"
        f"  disk: checkpoints of {disk:.2g} GB, {free:.3g} free"
    )


def make_plan(trainer: lightning.Trainer, module: SplattingModule) -> str:
    """Try a micro-batch, check memory and disk, and describe what the training needs.

    The network is left as it was.

    Raises:
        InputError: a step does not fit into memory, or checkpoints do not fit on the disk.
    """
    parameters, free = count_parameters(module.net), math.inf
    if trainer.checkpoint_callback is not None:
        folder = Path(trainer.checkpoint_callback.dirpath).absolute()
        existing = next(path for path in (folder, *folder.parents) if path.exists())
        free = shutil.disk_usage(existing).free / GB
    disk = CHECKPOINTS * SAVED_BYTES * parameters / GB
    if disk > free:
        raise InputError(
            f"the checkpoints of a run need {disk:.3g} GB and the disk of paths.logs has {free:.3g}"
            ": name a folder on a larger disk, or delete older runs."
        )
    capacity = memory_gb(module.device)
    capacity /= 1 if module.device.type == "cuda" else trainer.num_devices
    try:
        seconds, needed = _try(trainer, module)
    except torch.OutOfMemoryError:
        seconds, needed = math.nan, math.inf
    shards = trainer.world_size if isinstance(trainer.strategy, ShardedStrategy) else 1
    needed += MOMENT_BYTES * parameters / shards / GB
    if needed > capacity:
        amount = "more" if math.isinf(needed) else f"about {needed:.3g} GB"
        raise InputError(
            f"a training step needs {amount}, and each process has {capacity:.3g} GB: set "
            "training.checkpoint_layers=true, training.views_at_once=1 and a smaller "
            "data.micro_batch; if that is not enough, take fewer data.inputs, smaller data.height "
            "and data.width, or a larger device."
        )
    return plan_lines(parameters, trainer.max_steps, needed, capacity, seconds, disk, free)


def _try(trainer: lightning.Trainer, module: SplattingModule) -> tuple[float, float]:
    """Return the seconds of a step's micro-batches, and the peak memory of one in 1e9 bytes."""
    split = trainer.datamodule.split(trainer.world_size)
    batch = collate([TrainingTasks(trainer.datamodule)[0]] * split.micro_batch)
    batch |= {name: batch[name].to(module.device) for name in ("inputs", "targets")}
    buffers = [buffer.clone() for buffer in module.net.buffers()]
    meter = CostMeter(module.device)
    for _ in range(2):  # the first may compile kernels
        meter.start()
        with trainer.precision_plugin.forward_context():
            loss = module.compute_terms(batch)["loss"]
        loss.backward()
        module.zero_grad(set_to_none=True)
        meter.stop()
    for buffer, before in zip(module.net.buffers(), buffers, strict=True):
        buffer.copy_(before)
    return split.accumulated * meter.seconds[-1], max(meter.gb, default=0.0)
