"""A non-finite step changes nothing, is named, kept and counted, and too many end the run."""

import re
import sys
from pathlib import Path

import lightning
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf
from tiny import NETWORK, STEPS, VIEWS
from torch import nn
from torch.utils.data import DataLoader

from asysplat.data.datamodule import collate
from asysplat.errors import InputError
from asysplat.scene import Cameras, Views
from asysplat.training.callbacks import NonFiniteSteps
from asysplat.training.non_finite import first_non_finite, main, replay

KEPT = ("model", "training", "trainer")  # of the configuration, what a step needs


def noise(views, size=4, scale=1.0, name="kitchen"):
    """A scene of noise, its last view the target."""
    pose = torch.eye(4).repeat(views, 1, 1)
    pose[:, 0, 3] = torch.linspace(-1, 1, views)
    intrinsics = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]]).float()
    cameras = Cameras(intrinsics.repeat(views, 1, 1), pose, size, size)
    both = Views(cameras, scale * torch.rand(views, 3, size, size))
    inputs, targets = both.select(range(views - 1)), both.select([views - 1])
    return {"scene": name, "inputs": inputs, "targets": targets}


class Module(lightning.LightningModule):
    """A layer of the inputs' brightness, and a norm; `scales` brighten the scenes it trains on."""

    def __init__(self, scales=()):
        super().__init__()
        self.scales = scales
        self.layer, self.norm = nn.Linear(1, 2, bias=False), nn.BatchNorm1d(2)
        self.history = []

    def terms(self, batch):
        seen = self.layer(batch["inputs"].images.mean((0, 2, 3, 4))[:, None])
        size, spread = seen.square().sum().sqrt(), self.norm(seen).square().sum()
        return {"loss": size + spread, "size": size}

    def training_step(self, batch, index):
        self.history.append({k: v.clone() for k, v in self.state_dict().items()})
        return self.terms(batch)["loss"]

    def configure_optimizers(self):
        return torch.optim.AdamW(self.parameters(), lr=0.1)

    def train_dataloader(self):
        samples = [noise(3, scale=scale, name=f"scene {i}") for i, scale in enumerate(self.scales)]
        return DataLoader(samples, collate_fn=collate)


def fit(module, folder, loader=None, **options):
    guard = NonFiniteSteps(folder, **options)
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=1,
        callbacks=[guard],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        default_root_dir=folder,
        gradient_clip_val=1.0,
    )
    trainer.fit(module, loader)
    return guard


def test_a_skipped_step_changes_nothing_and_is_named_and_kept(tmp_path, capsys):
    module = Module([1.0, float("nan"), 0.5])
    guard = fit(module, tmp_path)
    before, bad, after = module.history
    assert not torch.equal(before["layer.weight"], bad["layer.weight"])
    assert bad.keys() == after.keys() and "norm.running_mean" in bad
    assert all(torch.equal(bad[name], after[name]) for name in bad)
    assert guard.skipped == 1 and guard.in_a_row == 0
    said = capsys.readouterr().out
    kept = tmp_path / "non_finite" / "step-000001-0.pt"
    assert "step 1: the batch's inputs.images is not finite on scene 1; step skipped" in said
    assert f"python -m asysplat.training.non_finite {kept}\n" in said
    step = torch.load(kept, weights_only=True)
    assert step["scene"] == ["scene 1"] and step["inputs"]["images"].isnan().all()
    assert torch.equal(step["state_dict"]["layer.weight"], bad["layer.weight"])


def test_the_budget_and_the_files(tmp_path):
    with pytest.raises(InputError, match=r"^5 steps in a row .*\(last: the batch's inputs\.images"):
        fit(Module([1.0] + 9 * [float("inf")]), tmp_path, budget=5)
    kept = sorted(path.name for path in (tmp_path / "non_finite").iterdir())
    assert kept == [f"step-{step:06d}-0.pt" for step in (1, 2, 3)]


def first(module, scale=1.0):
    before = {name: value.clone() for name, value in module.state_dict().items()}
    found = first_non_finite(module, collate([noise(3, scale=scale)]))
    torch.testing.assert_close(module.state_dict(), before, rtol=0, atol=0, equal_nan=True)
    assert not any(part._forward_hooks for part in module.modules())
    return found


def test_the_first_tensor_is_named_wherever_it_is():
    assert first(Module()) is None
    assert first(Module(), scale=float("inf")) == "the batch's inputs.images"
    assert first(Module(), scale=0.0) == "the gradient at the output of layer"
    broken = Module()
    with torch.no_grad():
        broken.norm.weight[1] = torch.nan
    assert first(broken) == "the output of norm"
    with torch.no_grad():
        broken.layer.weight[0] = torch.inf
    assert first(broken) == "the output of layer"


@pytest.mark.medium
def test_a_kept_step_of_the_network_is_taken_again(repository, tmp_path, capsys, monkeypatch):
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        config = compose("train", [*NETWORK, *STEPS, *VIEWS, "training.loss.depth=0.0"])
    net = instantiate(config.model)
    with torch.no_grad():
        net.head.decode.weight[0, 0] = torch.nan
    module = instantiate(config.training, net=net)
    parts = {name: OmegaConf.to_container(config[name], resolve=True) for name in KEPT}
    module.save_hyperparameters(parts, logger=False)
    batch = [noise(4, size=32, name=name) for name in ("kitchen", "hall")]
    fit(module, tmp_path, DataLoader(batch, batch_size=2, collate_fn=collate))
    said = capsys.readouterr().out
    pattern = r"step 0: (.*) is not finite on kitchen; .*non_finite (\S+)"
    named, kept = re.search(pattern, said, re.DOTALL).groups()
    assert named == "the output of net.head.decode"
    assert replay(Path(kept)) == named
    monkeypatch.setattr(sys, "argv", ["non_finite", __file__])
    with pytest.raises(SystemExit, match=r"error: .*test_guard\.py cannot be read as a step"):
        main()
