"""Draw what a run has learned: comparisons of images, and the learning curve."""

import time
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from asysplat.evaluation.figures import comparison_figure, learning_curve
from asysplat.evaluation.metrics import write_csv
from asysplat.training.loggers import log_figure
from asysplat.training.parallel import Batch, Prediction


class Figures(Callback):
    """Draws a `comparison_figure` of scenes of each validation and test, as the paper's Figure 5.

    Args:
        scenes: the first so many of the validation and of the data set's own test; of further test
            sets one.
    """

    def __init__(self, folder: str, scenes: int):
        self.folder, self.scenes = Path(folder) / "figures", scenes

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        module: LightningModule,
        outputs: Prediction,
        batch: Batch,
        index: int,
        *_: object,
    ) -> None:
        if index < self.scenes:
            file = f"val-{index}-{trainer.global_step:06d}"
            self._draw(trainer, file, f"val/{index}", outputs, batch)

    def on_test_batch_end(
        self,
        trainer: Trainer,
        module: LightningModule,
        outputs: Prediction,
        batch: Batch,
        index: int,
        test_set: int = 0,
    ) -> None:
        name, count = "test", self.scenes
        if test_set:
            name, count = f"test-{list(trainer.datamodule.tests)[test_set]}", min(1, count)
        if index < count:
            self._draw(trainer, f"{name}-{index}", f"{name}/{batch['scene'][0]}", outputs, batch)

    def _draw(
        self, trainer: Trainer, file: str, name: str, outputs: Prediction, batch: Batch
    ) -> None:
        """Draw the first scene of a batch to a file, and to the loggers by a name."""
        if not trainer.is_global_zero:
            return
        first = (
            record.map(lambda tensor: tensor[0].detach())
            for record in (batch["inputs"], batch["targets"], outputs.rendering)
        )
        figure = comparison_figure(*first)
        self.folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(self.folder / f"{file}.png", dpi=100)
        for logger in trainer.loggers:
            log_figure(logger, name, figure, trainer.global_step)


class Curve(Callback):
    """Writes a row for each validation; draws them after training."""

    def __init__(self, folder: str):
        self.folder = Path(folder)
        self.rows: list[dict[str, float | int]] = []

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = state_dict["rows"]

    def on_fit_start(self, trainer: Trainer, module: LightningModule) -> None:
        minutes = self.rows[-1]["minutes"] if self.rows else 0.0
        self.started = time.monotonic() - 60 * minutes
        self._write(trainer)  # drops the rows after the checkpoint that a run resumes from

    def on_validation_end(self, trainer: Trainer, module: LightningModule) -> None:
        values = {k: v.item() for k, v in trainer.callback_metrics.items() if k.startswith("val/")}
        if not values:  # without the callback Metrics
            return
        row = {"step": trainer.global_step, "minutes": (time.monotonic() - self.started) / 60}
        row |= {name.removeprefix("val/"): value for name, value in values.items()}
        self.rows.append(row)
        self._write(trainer)

    def _write(self, trainer: Trainer) -> None:
        if self.rows and trainer.is_global_zero:
            write_csv(self.folder / "curve.csv", self.rows)

    def on_fit_end(self, trainer: Trainer, module: LightningModule) -> None:
        if self.rows and trainer.is_global_zero:
            (self.folder / "figures").mkdir(exist_ok=True)
            learning_curve(self.rows).savefig(self.folder / "figures" / "curve.png", dpi=100)
