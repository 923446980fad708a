"""Draw figures of every validation and of the test: for the loggers and as PNG files."""

from pathlib import Path

from lightning import Callback, LightningModule, Trainer

from asysplat.evaluation.figures import comparison_figure
from asysplat.training.loggers import log_figure
from asysplat.training.parallel_scenes import Batch
from asysplat.training.prediction import Prediction


class Figures(Callback):
    """Draws a `comparison_figure` of the first scenes of each validation and first test set.

    Args:
        folder: the run's folder; the PNG files are written to its sub-folder `figures`.
        scenes: how many scenes to draw.
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
        self._draw(trainer, "val", outputs, batch, index)

    def on_test_batch_end(
        self,
        trainer: Trainer,
        module: LightningModule,
        outputs: Prediction,
        batch: Batch,
        index: int,
        test_set: int = 0,
    ) -> None:
        if test_set == 0:
            self._draw(trainer, "test", outputs, batch, index)

    def _draw(
        self, trainer: Trainer, split: str, outputs: Prediction, batch: Batch, index: int
    ) -> None:
        if index >= self.scenes or not trainer.is_global_zero:
            return
        first = (
            record.map(lambda tensor: tensor[0].detach())
            for record in (batch["inputs"], batch["targets"], outputs.rendering)
        )
        figure = comparison_figure(*first)
        self.folder.mkdir(parents=True, exist_ok=True)
        step = "" if split == "test" else f"-{trainer.global_step:06d}"
        figure.savefig(self.folder / f"{split}-{index}{step}.png", dpi=100)
        name = f"{split}/{batch['scene'][0] if split == 'test' else index}"
        for logger in trainer.loggers:
            log_figure(logger, name, figure, trainer.global_step)
