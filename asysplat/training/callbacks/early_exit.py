"""Log the shares of work that the network's early exit leaves out at test."""

from typing import Any

import lightning

from asysplat.evaluation.rows import ImageRow, average
from asysplat.training.callbacks.metrics import gather


class EarlyExitShares(lightning.Callback):
    """Logs early_exit/<set>/<what>: the skipped shares, averaged over the scenes of a test set.

    `results` has the same numbers; it is empty with speed=exact. See `asysplat.models.early_exit`.
    """

    def on_test_epoch_start(self, *_: Any) -> None:
        self.rows: list[ImageRow] = []

    def on_test_batch_end(
        self, trainer: Any, module: Any, outputs: Any, batch: Any, index: int, set_index: int = 0
    ) -> None:
        if module.net.early_exit_shares:
            test_set = list(trainer.datamodule.tests)[set_index]
            (scene,) = batch["scene"]
            row = {"set": test_set, "scene": scene, "view": 0}
            self.rows.append(row | module.net.early_exit_shares)

    def on_test_epoch_end(self, trainer: Any, module: Any) -> None:
        rows = gather(trainer, self.rows)
        self.results = {
            f"early_exit/{test_set}/{name}": share
            for test_set in trainer.datamodule.tests
            for name, share in average([r for r in rows if r["set"] == test_set], "images").items()
        }
        module.log_dict(self.results)
