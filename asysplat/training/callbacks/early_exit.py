"""Log the shares of work that the network's early exit leaves out at test."""

from typing import Any

import lightning

from asysplat.evaluation.rows import ImageRow, average
from asysplat.training.callbacks.metrics import gather


class EarlyExitShares(lightning.Callback):
    """Logs skip/<set>/<what>: shares that were left out, averaged over the scenes of a test set.

    `results` has the same numbers; it is empty with speed=exact. See `asysplat.models.early_exit`.
    """

    def on_test_epoch_start(self, *_: Any) -> None:
        self.rows: list[ImageRow] = []

    def on_test_batch_end(
        self,
        trainer: Any,
        module: Any,
        outputs: Any,
        batch: dict[str, Any],
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if module.net.skipped:
            test_set = list(trainer.datamodule.tests)[dataloader_idx]
            (scene,) = batch["scene"]
            self.rows.append({"set": test_set, "scene": scene, "view": 0, **module.net.skipped})

    def on_test_epoch_end(self, trainer: Any, module: Any) -> None:
        rows = gather(trainer, self.rows)
        self.results = {
            f"skip/{test_set}/{name}": share
            for test_set in trainer.datamodule.tests
            for name, share in average([r for r in rows if r["set"] == test_set], "images").items()
        }
        module.log_dict(self.results)
