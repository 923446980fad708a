"""The trainer that conf/trainer makes reads training tasks that it has not read before."""

import lightning
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch.utils.data import DataLoader

STEPS, PER_EPOCH = 6, 2


class Numbers(lightning.LightningDataModule):
    """Task i is the number i."""

    def train_dataloader(self):
        start = self.trainer.current_epoch * PER_EPOCH
        return DataLoader(range(start, start + PER_EPOCH), batch_size=None)


class Module(lightning.LightningModule):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(1, 1)
        self.read = []

    def training_step(self, batch, index):
        self.read.append(int(batch))
        return self.layer(torch.ones(1)).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def test_no_task_comes_twice(repository, tmp_path):
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        config = compose("train", ["trainer=cpu", f"steps={STEPS}"]).trainer
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    module = Module()
    instantiate(config, default_root_dir=tmp_path, **quiet).fit(module, Numbers())
    assert module.read == list(range(STEPS))
