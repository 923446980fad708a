"""Measure every validation and test image, and the baselines that need no training."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor

from asysplat.evaluation import baselines
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.measured_cost import CostMeter
from asysplat.evaluation.protocol import Protocol
from asysplat.evaluation.rows import ImageRow, average, write_csv
from asysplat.scene import Views
from asysplat.training.outcome import Outcome

IMAGE = ("set", "scene", "view")  # the columns that say which image a row is of
Measure = Callable[[Tensor, Views], dict[str, Tensor]]


class Metrics(lightning.Callback):
    """Measures PSNR, SSIM, LPIPS, AbsRel and delta < 1.25 of each image, for the logger and a CSV.

    `results` holds the means of every test set, the protocol's sentences, and the cost of measuring
    a test scene and its baselines: cost/metrics_seconds and cost/metrics_gb, see `CostMeter`.

    Args:
        protocol: how everything is measured.
        folder: of the run; metrics.csv is written there after the test.
        backbone_dir: folder that may hold LPIPS' backbone; without it that column is missing.
        download: whether to fetch the backbone if it is missing.
    """

    def __init__(self, protocol: Protocol, folder: str, backbone_dir: str, download: bool = False):
        self.protocol, self.folder = protocol, Path(folder)
        self.backbone_dir, self.download = Path(backbone_dir), download
        self.rows: list[ImageRow] = []
        sentences = protocol.sentences()
        self.results: dict[str, float | str] = {f"protocol/{k}": v for k, v in sentences.items()}

    def setup(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, stage: str
    ) -> None:
        if hasattr(self, "lpips"):
            return
        self.lpips = load_lpips(self.protocol.lpips_net, self.backbone_dir, self.download)
        if self.lpips is None and trainer.is_global_zero:
            # Lightning calls this, and its own warnings are not shown.
            warnings.warn(self.protocol.without_lpips(), stacklevel=1)

    def measure(self, rendered: Tensor, targets: Views) -> dict[str, Tensor]:
        """Compute the image metrics, each [B, V]."""
        network = None if self.lpips is None else self.lpips.to(targets.images.device)
        return self.protocol.image_metrics(rendered, targets, network)

    def _add(
        self, test_set: str, batch: dict[str, Any], outcome: Outcome, measure_baseline: Measure
    ) -> None:
        inputs, targets = batch["inputs"], batch["targets"]
        values = self.measure(outcome.rendering.image, targets)
        values |= self.protocol.depth_metrics(outcome.rendering.depth, targets)
        for name in ("mean_color", "nearest_view"):
            found = measure_baseline(getattr(baselines, name)(inputs, targets), targets)
            values.update({f"{name}/{metric}": value for metric, value in found.items()})
        for index, scene in enumerate(batch["scene"]):
            for view in range(targets.num_views):
                numbers = {name: value[index, view].item() for name, value in values.items()}
                self.rows.append({"set": test_set, "scene": scene, "view": view, **numbers})

    def on_validation_epoch_start(self, *_: Any) -> None:
        self.rows = []

    def on_test_epoch_start(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        self.rows = []
        self.work = CostMeter(module.device)

    def on_validation_batch_end(
        self, trainer: Any, module: Any, outputs: Outcome, batch: Any, *_: Any
    ) -> None:
        def measure_baseline(image: Tensor, to: Views) -> dict[str, Tensor]:
            """Measure PSNR alone: the learning curve shows no other metric of the baselines."""
            return {"psnr": self.protocol.psnr(image, to)}

        self._add(trainer.datamodule.name, batch, outputs, measure_baseline)

    def on_test_batch_end(
        self,
        trainer: Any,
        module: Any,
        outputs: Outcome,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        test_set = list(trainer.datamodule.tests)[dataloader_idx]
        self.work.start()
        self._add(test_set, batch, outputs, self.measure)
        self.work.stop()

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        means = average(gather(trainer, self.rows), self.protocol.mean_over)
        module.log_dict({f"val/{name}": value for name, value in means.items()})

    def on_test_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        rows, results = gather(trainer, self.rows), {}
        for test_set in trainer.datamodule.tests:
            of_set = [row for row in rows if row["set"] == test_set]
            for name, value in average(of_set, self.protocol.mean_over).items():
                kind = "baseline" if "/" in name else "test"
                results[f"{kind}/{test_set}/{name}"] = value
        module.log_dict(results)
        self.results |= results | self.work.costs("cost/metrics")
        if trainer.is_global_zero:
            write_csv(self.folder / "metrics.csv", rows)


def gather(trainer: lightning.Trainer, rows: list[ImageRow]) -> list[ImageRow]:
    """Collect the rows of all processes; every process must call this."""
    if trainer.world_size == 1:
        return rows
    per_process: list[list[ImageRow]] = [[] for _ in range(trainer.world_size)]
    torch.distributed.all_gather_object(per_process, rows)
    # A scene that a process measured again, so that all take equally many turns, counts once.
    images = {tuple(row[key] for key in IMAGE): row for part in per_process for row in part}
    return list(images.values())
