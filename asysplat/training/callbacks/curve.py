"""Write the learning curve of a run, without TensorBoard: curve.csv and figures/curve.png."""

import time
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from asysplat.evaluation.figures import learning_curve
from asysplat.evaluation.rows import write_csv


class Curve(Callback):
    """Writes a row for each validation; draws them after training.

    Args:
        folder: the run's folder.
    """

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
