"""Measure the costs of a run: parameters, FLOPs, Gaussians, seconds, memory."""

import math
import statistics
from datetime import timedelta

import torch
from lightning import Callback, Trainer
from torch import Tensor
from torch.utils._pytree import tree_leaves

from asysplat.data.datamodule import SceneDataModule, TrainingTasks, collate
from asysplat.errors import InputError
from asysplat.evaluation.measured_cost import CostMeter, mean_but_longest, memory_gb
from asysplat.evaluation.static_cost import count_parameters, static_costs
from asysplat.training.loggers import log_numbers
from asysplat.training.module import SplattingModule


class Costs(Callback):
    """Collects the costs of a run in `values`, "cost/..." -> number.

    The `static_costs` of one scene at the run's views and resolution; seconds_per_step, the mean,
    and peak_gb of training; and inference_seconds, the mean of all but the longest, and
    inference_gb of the network's forward pass over test scenes, of further sets under cost/<set>/.
    """

    def __init__(self):
        self.values: dict[str, float | int] = {}

    def setup(self, trainer: Trainer, module: SplattingModule, stage: str) -> None:
        """Count costs and plan here, where every process still has all weights."""
        if stage != "fit":
            return
        module.to(trainer.strategy.root_device)
        scene = trainer.datamodule.evaluation["val"][0]["inputs"]
        costs = static_costs(module.net, scene.num_views, *scene.images.shape[-2:])
        plan = make_plan(trainer, module)
        if trainer.is_global_zero:
            print(plan, flush=True)
        self.values = {f"cost/{name}": value for name, value in costs.items()}

    def on_fit_start(self, trainer: Trainer, module: SplattingModule) -> None:
        self.step = CostMeter(module.device)

    def on_train_start(self, trainer: Trainer, module: SplattingModule) -> None:
        if trainer.global_step == 0:  # a resumed run has logged them
            log_numbers(trainer, self.values, 0)

    def on_train_batch_start(self, *_: object) -> None:
        self.step.start()

    def on_train_batch_end(self, *_: object) -> None:
        self.step.stop()

    def on_fit_end(self, trainer: Trainer, module: SplattingModule) -> None:
        if self.step.seconds:
            seconds = trainer.accumulate_grad_batches * statistics.fmean(self.step.seconds)
            self.values["cost/seconds_per_step"] = seconds
        if self.step.gb:
            self.values["cost/peak_gb"] = max(self.step.gb)
        log_numbers(trainer, self.values, trainer.global_step)

    def on_test_start(self, trainer: Trainer, module: SplattingModule) -> None:
        self.tests = [CostMeter(module.device) for _ in trainer.datamodule.tests]
        self.hooks = [
            module.net.register_forward_pre_hook(lambda *_: self.inference.start()),
            module.net.register_forward_hook(lambda *_: self.inference.stop()),
        ]

    def on_test_batch_start(
        self,
        trainer: Trainer,
        module: SplattingModule,
        batch: object,
        index: int,
        set_index: int = 0,
    ) -> None:
        self.inference = self.tests[set_index]

    def on_test_end(self, trainer: Trainer, module: SplattingModule) -> None:
        for hook in self.hooks:
            hook.remove()
        for test_set, meter in zip(trainer.datamodule.tests, self.tests, strict=True):
            prefix = "cost" if test_set == trainer.datamodule.name else f"cost/{test_set}"
            if meter.seconds:
                self.values[f"{prefix}/inference_seconds"] = mean_but_longest(meter.seconds)
            if meter.gb:
                self.values[f"{prefix}/inference_gb"] = max(meter.gb)


def make_plan(trainer: Trainer, module: SplattingModule) -> str:
    """Try a micro-batch, refuse what does not fit, and describe the training."""
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
    load_seconds, task_bytes = _try_loading(trainer.datamodule)
    split = trainer.datamodule.split(trainer.world_size)
    workers = math.ceil(load_seconds * split.micro_batch * split.accumulated / seconds)
    held = workers * trainer.datamodule.prefetch * split.micro_batch * task_bytes
    return (
        f"plan: {count_parameters(module.net) / 1e6:.2f}M parameters, {trainer.max_steps:,} steps\n"
        f"  memory: about {needed:.3g} of {capacity:.3g} GB\n"
        f"  time: {seconds:.3g} s a step, {time} without validation\n"
        f"  loading: {load_seconds:.3g} s a task; data.num_workers={workers} of each process keep "
        f"up, and hold {held / 1e9:.2g} GB in /dev/shm"
    )


def _try_loading(data: SceneDataModule) -> tuple[float, int]:
    """Return the seconds in which one process loads a training task, and the task's bytes."""
    tasks, meter = TrainingTasks(data), CostMeter(torch.device("cpu"))
    meter.start()
    sample = tasks[1]  # the first one compiled kernels
    meter.stop()
    tensors = tree_leaves([vars(sample[views]) for views in ("inputs", "targets")])
    return meter.seconds[0], sum(t.nbytes for t in tensors if isinstance(t, Tensor))


def _try(trainer: Trainer, module: SplattingModule) -> tuple[float, float]:
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
