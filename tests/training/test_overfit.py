"""The whole chain can learn: network, renderer, loss and optimizer on one scene."""

import pytest
import torch
from test_module import make_module

from asysplat.data.datamodule import collate, load
from asysplat.data.procedural import ProceduralScene
from asysplat.data.selection import uniform_selection
from asysplat.data.sources import Task
from asysplat.evaluation.metrics import psnr

STEPS = 250


@pytest.mark.slow
def test_one_scene_overfitted_passes_30_db(build):
    scene = ProceduralScene(3, 32, 32)
    batch = collate([load(Task(scene, uniform_selection(96, 4, 2)))])
    net = build("width=0.25", "state_size=32", "model.layers=1m1s")
    adamw = {"betas": (0.9, 0.95), "weight_decay": 0.0}
    module = make_module(net, warmup_steps=10, total_steps=STEPS, **adamw)
    options = module.configure_optimizers()
    optimizer, schedule = options["optimizer"], options["lr_scheduler"]["scheduler"]
    for step in range(STEPS):
        prediction = module(batch, depth=False)
        optimizer.zero_grad()
        module.loss(prediction, batch)["loss"].backward()
        optimizer.step()
        schedule.step()
        if step % 25 == 24:
            with torch.no_grad():
                rendering = module.eval()(batch, depth=False).rendering
            module.train()
            quality = psnr(rendering.image, batch["targets"].images).mean()
            if quality >= 30:
                break
    assert quality >= 30
