"""What a run costs: parameters, FLOPs, Gaussians, seconds a step, memory."""

import copy
import time
from typing import Any

import lightning
import torch

from asysplat.evaluation.cost import count_parameters, module_flops, peak_memory_gb, true_flops
from asysplat.scene import Views

WARM_UP_STEPS = 5
GIGA = 1e9


class Costs(lightning.Callback):
    """Writes `values`, "cost/..." -> number; what needs no running is known before the first step.

    gflops counts as the paper does (Linear and Conv modules of one scene's forward), gflops_true
    every product, attention and scans as matrices included; both at the run's views and resolution.
    """

    def __init__(self):
        self.values: dict[str, float | int] = {}
        self.seconds: list[float] = []

    def on_fit_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        if module.device.type == "cuda":
            # Jobs of a sweep share a process, and the peak would be that of the largest.
            torch.cuda.reset_peak_memory_stats(module.device)
        scene = trainer.datamodule.evaluation["val"][0]["inputs"]
        self.values = static_costs(module.net, scene)
        for logger in trainer.loggers:
            logger.log_metrics(self.values, step=0)

    def on_train_batch_start(self, trainer: lightning.Trainer, *_: Any) -> None:
        self.started = time.perf_counter()

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any
    ) -> None:
        if module.device.type == "cuda":
            torch.cuda.synchronize(module.device)
        self.seconds.append(time.perf_counter() - self.started)

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        measured = self.seconds[WARM_UP_STEPS:]
        if measured:
            self.values["cost/seconds_per_step"] = torch.tensor(measured).median().item()
        self.values["cost/peak_gb"] = peak_memory_gb(module.device)
        for logger in trainer.loggers:
            logger.log_metrics(self.values, step=trainer.global_step)


def static_costs(net: torch.nn.Module, scene: Views) -> dict[str, float | int]:
    """Costs of one scene's forward pass, from a copy of the network on the meta device."""
    on_meta = copy.deepcopy(net).to("meta").eval()
    views = scene.to("meta")

    def run() -> object:
        return on_meta(views)

    with torch.no_grad():
        return {
            "cost/parameters": count_parameters(net),
            "cost/geometry_share": net.geometry_share(),
            "cost/gflops": module_flops(on_meta, run) / GIGA,
            "cost/gflops_true": true_flops(run) / GIGA,
            "cost/gaussians": run().num_gaussians,
        }
