"""What a training takes, told before its first step: memory, time, disk, and whether it fits.

Memory is counted (asysplat/training/memory.py); time is that of a micro-batch, tried twice.
"""

import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import lightning
import torch

from asysplat.data.batches import BatchSplit
from asysplat.data.datamodule import Sample, TrainingTasks, collate
from asysplat.errors import InputError
from asysplat.evaluation.cost import GB, memory_gb, peak_memory_gb
from asysplat.evaluation.measured_cost import CostMeter
from asysplat.evaluation.static_cost import Activations, count_activations
from asysplat.training.memory import IMAGE_BYTES, PERCEPTUAL_BYTES, Held, Sizes
from asysplat.training.module import SplattingModule
from asysplat.training.sharded import ShardedStrategy

SAVED_BYTES = 12  # of a parameter in a checkpoint, which has no gradients
CHECKPOINTS = 3  # best, last, and one that is being written
LESS = 0.7  # of what was counted is suggested where that did not fit


@dataclass(frozen=True)
class Plan:
    """What a training takes; printed as lines.

    Args:
        parameters, steps: of the network, of the optimizer.
        parts: memory of a process by what it is for, in 1e9 bytes.
        held_gb: memory that the process held before.
        capacity_gb: of the device, for each process.
        tried_gb: by how much memory rose as a micro-batch was tried, without an optimizer.
        seconds: of the micro-batches of a step, without optimizer and communication.
        disk_gb, free_gb: of a run's checkpoints, and of their disk.
    """

    parameters: int
    steps: int
    parts: dict[str, float]
    held_gb: float
    capacity_gb: float
    tried_gb: float
    seconds: float
    disk_gb: float
    free_gb: float

    def __str__(self) -> str:
        counted = ", ".join(f"{name} {gb:.2g}" for name, gb in self.parts.items())
        total = sum(self.parts.values()) + self.held_gb
        time = timedelta(seconds=round(self.steps * self.seconds))
        return (
            f"plan: {self.parameters / 1e6:.2f}M parameters, {self.steps:,} steps\n"
            f"  memory: about {total:.3g} of {self.capacity_gb:.3g} GB: {counted}, and "
            f"{self.held_gb:.2g} held before; a micro-batch took {self.tried_gb:.2g}\n"
            f"  time: {self.seconds:.3g} s a step, {time} without validation\n"
            f"  disk: checkpoints of {self.disk_gb:.2g} GB, {self.free_gb:.3g} free"
        )


def make_plan(
    trainer: lightning.Trainer,
    module: SplattingModule,
    costs: Mapping[str, float | int],
    held_gb: float,
) -> Plan:
    """Count, check and try what a training takes; the network is left as it was.

    Args:
        trainer: has its data module, with tasks.
        module: on its device.
        costs: the `static_costs` of one of the data's scenes.
        held_gb: memory that the process holds already, in 1e9 bytes.

    Raises:
        InputError: a step does not fit into memory, or checkpoints do not fit on the disk.
    """
    split = trainer.datamodule.split(trainer.world_size)
    share = split.micro_batch * split.accumulated
    checkpointing = any(getattr(m, "checkpointing", False) for m in module.net.modules())
    held = Held(split.micro_batch, checkpointing, module.views_at_once)
    sample = TrainingTasks(trainer.datamodule)[0]
    sizes = _sizes(trainer, module, costs, sample)
    capacity = memory_gb(module.device)
    capacity /= 1 if module.device.type == "cuda" else trainer.num_devices
    needed = sizes.gb(held) + held_gb
    if needed > capacity:
        raise InputError(
            f"a training step needs about {needed:.3g} GB, and each process has {capacity:.3g}: "
            f"{sizes.that_fits(held, share, capacity - held_gb)}."
        )
    disk, free = CHECKPOINTS * SAVED_BYTES * costs["parameters"] / GB, _free_gb(trainer)
    if disk > free:
        raise InputError(
            f"the checkpoints of a run need {disk:.3g} GB and the disk of paths.logs has {free:.3g}"
            ": name a folder on a larger disk, or delete older runs."
        )
    try:
        seconds, tried = _try(trainer, module, sample, split)
    except torch.OutOfMemoryError as error:
        raise InputError(
            f"a training step does not fit into {capacity:.3g} GB, though {needed:.3g} were "
            f"counted: {sizes.that_fits(held, share, LESS * sizes.gb(held))}."
        ) from error
    return Plan(
        parameters=costs["parameters"],
        steps=trainer.max_steps,
        parts=sizes.parts(held),
        held_gb=held_gb,
        capacity_gb=capacity,
        tried_gb=tried,
        seconds=seconds,
        disk_gb=disk,
        free_gb=free,
    )


def _sizes(
    trainer: lightning.Trainer,
    module: SplattingModule,
    costs: Mapping[str, float | int],
    sample: Sample,
) -> Sizes:
    inputs, targets = sample["inputs"].images, sample["targets"].images
    activations = Activations(costs["activation_gb"], costs["checkpointed_gb"])
    if trainer.precision == "bf16-mixed":
        with torch.autocast("cpu", torch.bfloat16):  # where the tensors without content are
            activations = count_activations(module.net, *inputs.shape[:1], *inputs.shape[-2:])
    sharded = isinstance(trainer.strategy, ShardedStrategy)
    loss = module.loss
    return Sizes(
        parameters=costs["parameters"] // (trainer.world_size if sharded else 1),
        activations=activations,
        gaussians=costs["gaussians"],
        fields_gb=costs["gaussians_gb"],
        targets=len(targets),
        pixels=targets[0, 0].numel(),
        pixel_bytes=PERCEPTUAL_BYTES * bool(loss.perceptual) + IMAGE_BYTES * bool(loss.ssim),
        side_by_side=torch.get_num_threads() if module.device.type == "cpu" else None,
    )


def _try(
    trainer: lightning.Trainer, module: SplattingModule, sample: Sample, split: BatchSplit
) -> tuple[float, float]:
    """Return the seconds of a step, and by how many GB a micro-batch lets the memory rise."""
    batch = collate([sample] * split.micro_batch)
    batch |= {name: batch[name].to(module.device) for name in ("inputs", "targets")}
    buffers = [buffer.clone() for buffer in module.net.buffers()]
    meter = CostMeter(module.device)
    before = peak_memory_gb(module.device)
    for _ in range(2):  # the first may compile
        meter.start()
        with trainer.precision_plugin.forward_context():
            loss = module.compute_terms(batch)["loss"]
        loss.backward()
        module.zero_grad(set_to_none=True)
        meter.stop()
    for buffer, was in zip(module.net.buffers(), buffers, strict=True):
        buffer.copy_(was)
    return split.accumulated * meter.seconds[-1], max(meter.gb, default=before) - before


def _free_gb(trainer: lightning.Trainer) -> float:
    """Return what is free on the disk that checkpoints go to; without checkpoints it is endless."""
    if trainer.checkpoint_callback is None:
        return math.inf
    folder = Path(trainer.checkpoint_callback.dirpath).absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    return shutil.disk_usage(existing).free / GB
