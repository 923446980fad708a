"""The learning curve of a run, without TensorBoard: curve.csv and pictures/curve.png."""

import csv
import time
from pathlib import Path
from typing import Any

import lightning

from asysplat.evaluation.pictures import learning_curve

COLUMNS = ("psnr", "nearest_view/psnr", "mean_colour/psnr", "ssim", "lpips", "absrel")


class Curve(lightning.Callback):
    """Keeps a row for each validation that was measured; writes and draws them after training.

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

    def on_fit_start(self, *_: Any) -> None:
        minutes = self.rows[-1]["minutes"] if self.rows else 0.0
        self.started = time.monotonic() - 60 * minutes

    def on_validation_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        found = trainer.callback_metrics
        if "val/psnr" not in found:  # no callback measures
            return
        row = {"step": trainer.global_step, "minutes": (time.monotonic() - self.started) / 60}
        row |= {name: found[f"val/{name}"].item() for name in COLUMNS if f"val/{name}" in found}
        self.rows.append(row)

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        if self.rows and trainer.is_global_zero:
            write_curve(self.folder, self.rows)


def write_curve(folder: Path, rows: list[dict[str, float | int]]) -> None:
    """Write curve.csv and pictures/curve.png of validations, oldest first."""
    with (folder / "curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[-1]))
        writer.writeheader()
        writer.writerows(rows)
    (folder / "pictures").mkdir(exist_ok=True)
    learning_curve(rows).savefig(folder / "pictures" / "curve.png", dpi=100)
