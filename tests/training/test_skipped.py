"""Non-finite steps and bad scenes are reported and counted; too many of the steps end the run."""

import lightning
import pytest
import torch
from hydra.utils import instantiate
from tiny import NETWORK, QUIET, STEPS, VIEWS, OneLayer
from torch import nn
from torch.utils.data import DataLoader

from asysplat.data.datamodule import collate
from asysplat.errors import InputError
from asysplat.scene import Cameras, Views
from asysplat.training.callbacks import BadScenes, NonFiniteSteps


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

    net = None

    def scene_terms(self, batch, net=None):
        values = self.layer(batch["inputs"].images.mean((0, 2, 3, 4))[:, None])
        size, spread = values.square().sum().sqrt(), self.norm(values).square().sum()
        return {"loss": size + spread, "size": size}

    def training_step(self, batch, index):
        self.history.append({k: v.clone() for k, v in self.state_dict().items()})
        return self.scene_terms(batch)["loss"]

    def configure_optimizers(self):
        return torch.optim.AdamW(self.parameters(), lr=0.1)

    def train_dataloader(self):
        samples = [noise(3, scale=scale, name=f"scene {i}") for i, scale in enumerate(self.scales)]
        return DataLoader(samples, collate_fn=collate)


def fit(module, callback, folder, loader=None, **options):
    trainer = lightning.Trainer(
        **QUIET,
        max_epochs=1,
        callbacks=[callback],
        enable_checkpointing=False,
        default_root_dir=folder,
        **options,
    )
    trainer.fit(module, loader)
    return trainer


def fit_finite(module, folder, loader=None, **options):
    callback = NonFiniteSteps(**options)
    fit(module, callback, folder, loader, gradient_clip_val=1.0)
    return callback


def test_a_non_finite_step_is_dropped_and_reported(tmp_path, capsys):
    module = Module([1.0, float("nan"), 0.5])
    callback = fit_finite(module, tmp_path)
    before, bad, after = module.history
    assert not torch.equal(before["layer.weight"], bad["layer.weight"])
    assert bad.keys() == after.keys() and "norm.running_mean" in bad
    assert all(torch.equal(bad[name], after[name]) for name in bad)
    assert callback.count == 1 and callback.in_a_row == 0
    output = capsys.readouterr().out
    said = "step 1: the gradient of layer.weight, norm.bias, norm.weight is not finite on scene 1;"
    assert said in output


def test_budget_of_non_finite_steps(tmp_path):
    with pytest.raises(InputError, match=r"^5 steps in a row .*\(last: that of layer\.weight"):
        fit_finite(Module([1.0] + 9 * [float("inf")]), tmp_path, budget=5)


@pytest.mark.medium
@pytest.mark.parametrize("optimizer", ["adamw", "muon"])
def test_spikes_in_mixed_precision_leave_finite_weights(composed, tmp_path, capsys, optimizer):
    """Finite spikes, beyond what bfloat16 squares, are clipped or dropped; others are dropped."""
    spikes = [1, 1e30, 0.5, float("inf"), 1e6, float("nan"), 1]
    options = ["training.loss.depth=0.0", f"training/optimizer={optimizer}"]
    config = composed(*NETWORK, *STEPS, *VIEWS, *options)
    module = instantiate(config.training, net=instantiate(config.model))
    before = [parameter.clone() for parameter in module.parameters()]
    scenes = [noise(4, size=32, scale=s, name=f"scene {i}") for i, s in enumerate(spikes)]
    loader = DataLoader(scenes, collate_fn=collate)
    callback = NonFiniteSteps()
    fit(module, callback, tmp_path, loader, precision="bf16-mixed", gradient_clip_val=1.0)
    assert all(value.isfinite().all() for value in module.state_dict().values())
    changed = [not torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True)]
    assert any(changed) and 2 <= callback.count <= 4 and callback.in_a_row == 0
    output = capsys.readouterr().out
    assert "scene 3; the step is dropped" in output and "scene 5; the step is dropped" in output


def test_bad_scenes_are_counted_and_named_at_the_end(tmp_path, capsys):
    counter = BadScenes()
    batches = [{"bad_scenes": errors} for errors in (["a is cut"], [], ["b is cut", "a is cut"])]
    trainer = fit(OneLayer(), counter, tmp_path, DataLoader(batches, batch_size=None))
    assert trainer.callback_metrics["train/bad_scenes"] == 3
    assert capsys.readouterr().out == "3 training scenes were replaced: a is cut, b is cut\n"
    again = BadScenes()
    again.load_state_dict(counter.state_dict())
    assert (again.count, again.errors) == (3, ["a is cut", "b is cut"])
