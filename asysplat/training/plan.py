"""Try a micro-batch before the first step: the time and memory that a training needs."""

import math
from datetime import timedelta

import lightning
import torch

from asysplat.data.datamodule import TrainingTasks, collate
from asysplat.errors import InputError
from asysplat.evaluation.measured_cost import CostMeter, memory_gb
from asysplat.evaluation.static_cost import count_parameters
from asysplat.training.module import SplattingModule


def make_plan(trainer: lightning.Trainer, module: SplattingModule) -> str:
    """Try a micro-batch and describe the training: parameters, steps, memory in 1e9 bytes, time.

    The network is left as it was. The memory is without the optimizer's moments.

    Raises:
        InputError: a micro-batch does not fit into memory.
    """
    capacity = memory_gb(module.device)
    capacity /= 1 if module.device.type == "cuda" else trainer.num_devices
    try:
        seconds, needed = _try(trainer, module)
    except torch.OutOfMemoryError:
        seconds, needed = math.nan, math.inf
    if needed > capacity:
        amount = "more" if math.isinf(needed) else f"about {needed:.3g} GB"
        raise InputError(
            f"a training step needs {amount}, and each process has {capacity:.3g} GB: set "
            "training.checkpoint_layers=true, training.views_at_once=1 and a smaller "
            "data.micro_batch; if that is not enough, take fewer data.inputs, smaller data.height "
            "and data.width, or a larger device."
        )
    time = timedelta(seconds=round(trainer.max_steps * seconds))
    return (
        f"plan: {count_parameters(module.net) / 1e6:.2f}M parameters, {trainer.max_steps:,} steps\n"
        f"  memory: about {needed:.3g} of {capacity:.3g} GB\n"
        f"  time: {seconds:.3g} s a step, {time} without validation"
    )


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
