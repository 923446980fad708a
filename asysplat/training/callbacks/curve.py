"""The learning curve of a run, without TensorBoard: curve.csv and pictures/curve.png."""

import csv
import time
from pathlib import Path
from typing import Any

import lightning

from asysplat.evaluation.figures import learning_curve
from asysplat.files import atomic_write

COLUMNS = ("psnr", "nearest_view/psnr", "mean_color/psnr", "ssim", "lpips", "absrel")


class Curve(lightning.Callback):
    """Writes a row for each validation that was measured; draws them after training.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: str):
        self.folder = Path(folder)
        self.rows: list[dict[str, float | int]] = []

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = state_dict["rows"]

    def on_fit_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        minutes = self.rows[-1]["minutes"] if self.rows else 0.0
        self.started = time.monotonic() - 60 * minutes
        self._write(trainer)  # without what came after the checkpoint of a run that goes on

    def on_validation_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        found = trainer.callback_metrics
        if "val/psnr" not in found:  # no callback measures
            return
        row = {"step": trainer.global_step, "minutes": (time.monotonic() - self.started) / 60}
        row |= {name: found[f"val/{name}"].item() for name in COLUMNS if f"val/{name}" in found}
        self.rows.append(row)
        self._write(trainer)

    def _write(self, trainer: lightning.Trainer) -> None:
        if self.rows and trainer.is_global_zero:
            write_curve(self.folder / "curve.csv", self.rows)

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        if self.rows and trainer.is_global_zero:
            (self.folder / "pictures").mkdir(exist_ok=True)
            picture = self.folder / "pictures" / "curve.png"
            learning_curve(self.rows).savefig(picture, dpi=100)


def write_curve(path: Path, rows: list[dict[str, float | int]]) -> None:
    """Write a line for each validation, oldest first; the file is there whole or not at all."""
    with atomic_write(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[-1]))
        writer.writeheader()
        writer.writerows(rows)
