"""Compute the metrics of every validation and test image, and of the baselines."""

import warnings
from operator import itemgetter
from pathlib import Path

import torch
from lightning import Callback, Trainer

from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.metrics import ImageRow, average, write_csv
from asysplat.evaluation.protocol import Protocol
from asysplat.training.loggers import log_charts
from asysplat.training.module import SplattingModule
from asysplat.training.parallel import Batch, Prediction

IMAGE = ("set", "scene", "view")  # the columns that identify a row


class Metrics(Callback):
    """Computes the protocol's metrics of each image, for loggers and a CSV.

    `results` holds the means of every test set and the protocol's descriptions.
    Rows of images are gathered, and not the sums of torchmetrics' classes, since processes may
    repeat an image to have as many batches as the others, and the CSV has each image.
    """

    def __init__(self, protocol: Protocol, folder: str, backbone_dir: str, download: bool = False):
        self.protocol, self.folder = protocol, Path(folder)
        self.backbone_dir, self.download = Path(backbone_dir), download
        self.charted, self.rows = False, list[ImageRow]()
        self.results: dict[str, float | str] = {}

    def setup(self, trainer: Trainer, module: SplattingModule, stage: str) -> None:
        if hasattr(self, "lpips"):
            return
        self.lpips = load_lpips(self.protocol.lpips_net, self.backbone_dir, self.download)
        if self.lpips is None and trainer.is_global_zero:
            warnings.warn(f"LPIPS is {self.protocol.without_lpips()}.", stacklevel=1)
        self.results |= self.protocol.notes(self.lpips)

    def _add(self, test_set: str, batch: Batch, prediction: Prediction, validation: bool) -> None:
        lpips = None if self.lpips is None else self.lpips.to(prediction.rendering.image.device)
        parts = batch["inputs"], batch["targets"], prediction.rendering
        for index, scene in enumerate(batch["scene"]):
            inputs, targets, drawn = (part.map(itemgetter(index)) for part in parts)
            rows = self.protocol.measure_views(drawn.image, drawn.depth, targets, lpips)
            # The learning curve has no other metric of the baselines.
            baselines = self.protocol.measure_baselines(inputs, targets, lpips, validation)
            for view, row in enumerate(rows):
                for name, numbers in baselines.items():
                    row |= {f"{name}/{metric}": value for metric, value in numbers[view].items()}
                self.rows.append({"set": test_set, "scene": scene, "view": view} | row)

    def on_validation_epoch_start(self, *_: object) -> None:
        self.rows = []

    def on_test_epoch_start(self, *_: object) -> None:
        self.rows = []

    def on_validation_batch_end(
        self, trainer: Trainer, _: SplattingModule, outputs: Prediction, batch: Batch, *__: object
    ) -> None:
        self._add(trainer.datamodule.name, batch, outputs, validation=True)

    def on_test_batch_end(
        self,
        trainer: Trainer,
        module: SplattingModule,
        outputs: Prediction,
        batch: Batch,
        index: int,
        set_index: int = 0,
    ) -> None:
        test_set = list(trainer.datamodule.tests)[set_index]
        self._add(test_set, batch, outputs, validation=False)

    def on_validation_epoch_end(self, trainer: Trainer, module: SplattingModule) -> None:
        means = average(gather(trainer, self.rows), self.protocol.mean_over)
        module.log_dict({f"val/{name}": value for name, value in means.items()})
        for logger in () if self.charted else trainer.loggers:
            log_charts(logger, means)
        self.charted = True

    def on_test_epoch_end(self, trainer: Trainer, module: SplattingModule) -> None:
        rows, results = gather(trainer, self.rows), {}
        for test_set in trainer.datamodule.tests:
            of_set = [row for row in rows if row["set"] == test_set]
            for name, value in average(of_set, self.protocol.mean_over).items():
                kind = "baseline" if "/" in name else "test"
                results[f"{kind}/{test_set}/{name}"] = value
        module.log_dict(results)
        self.results |= results
        if trainer.is_global_zero:
            write_csv(self.folder / "metrics.csv", rows)


def gather(trainer: Trainer, rows: list[ImageRow]) -> list[ImageRow]:
    """Gather the rows of all processes; every process must call this."""
    if trainer.world_size == 1:
        return rows
    per_process: list[list[ImageRow]] = [[] for _ in range(trainer.world_size)]
    torch.distributed.all_gather_object(per_process, rows)
    # A scene that pads the batches of a process to the same number counts once.
    images = {tuple(row[key] for key in IMAGE): row for part in per_process for row in part}
    return list(images.values())
