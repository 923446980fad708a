"""Scenes side by side: the mean of the scenes' losses and gradients, whatever the threads."""

import pytest
import torch
from test_module import make_module
from torch import nn

from asysplat.scene import Cameras, Views
from asysplat.training import SplattingLoss, parallel
from asysplat.training.parallel import ParallelScenes, split

SCENES = 3


def make_batch(scenes=SCENES):
    """Noise seen from a line of cameras; each scene knows other pixels' depths."""
    generator = torch.Generator().manual_seed(0)
    pose = torch.eye(4).repeat(scenes, 3, 1, 1)
    pose[..., 0, 3] = torch.linspace(-1, 1, 3)
    intrinsics = torch.tensor([[30.0, 0, 16], [0, 30.0, 16], [0, 0, 1]]).repeat(scenes, 3, 1, 1)
    images = torch.rand(scenes, 3, 3, 32, 32, generator=generator)
    depths = 1 + torch.rand(scenes, 3, 32, 32, generator=generator)
    depths[0, ..., 4:] = 0
    views = Views(Cameras(intrinsics, pose, 32, 32), images, depths)
    names = [f"scene {index}" for index in range(scenes)]
    return {"scene": names, "inputs": views.select([0, 1]), "targets": views.select([2])}


@pytest.fixture
def module(build):
    torch.manual_seed(0)
    module = make_module(
        build("width=0.125", "state_size=8", "model.layers=1m1s", "model/head=residual")
    )
    module.loss = SplattingLoss(mse=1.0, perceptual=0.0, depth=0.1)
    return module


def state(module):
    """What a step of training left: gradients and running means."""
    found = {name: p.grad.clone() for name, p in module.net.named_parameters() if p.requires_grad}
    return found | {name: buffer.clone() for name, buffer in module.net.named_buffers()}


def one_by_one(module, batch):
    """The expected step: each scene by itself from the same running means, then the mean."""
    start = {name: buffer.clone() for name, buffer in module.net.named_buffers()}
    losses, states = [], []
    for scene in split(batch):
        module.zero_grad()
        module.net.load_state_dict(start, strict=False)
        terms = module.scene_terms(scene, module.net)
        terms["loss"].backward()
        losses.append(terms["loss"].item())
        states.append(state(module))
    module.net.load_state_dict(start, strict=False)
    module.zero_grad()
    means = {k: torch.stack([each[k].double() for each in states]).mean(0) for k in states[0]}
    return sum(losses) / SCENES, means


def test_the_mean_over_scenes(module):
    batch = make_batch()
    expected, means = one_by_one(module, batch)
    terms = module._parallel_scenes(batch)
    (0.5 * terms["loss"]).backward()  # as for every second step of the optimizer
    assert terms["loss"].item() == pytest.approx(expected, rel=1e-6)
    parameters = dict(module.net.named_parameters())
    assert any("running_mean" in name for name in means)
    for name, found in state(module).items():
        factor = 0.5 if name in parameters else 1.0
        torch.testing.assert_close(found.double(), factor * means[name], rtol=1e-4, atol=1e-7)
    assert all(p.grad is not None for p in parameters.values() if p.requires_grad)


@pytest.mark.medium
def test_the_terms_of_a_batch_are_means_over_its_scenes(module):
    batch, net = make_batch(), module.net.eval()
    with torch.no_grad():
        whole = module.scene_terms(batch, net)
        scenes = [module.scene_terms(scene, net) for scene in split(batch)]
    assert whole.keys() == {"loss", "mse", "depth", "psnr"} and whole["depth"] > 0
    for name, term in whole.items():
        mean = torch.stack([each[name] for each in scenes]).mean()
        torch.testing.assert_close(term, mean, rtol=1e-4, atol=0)


@pytest.mark.medium
def test_any_number_of_workers_gives_the_same_bits(module, threads, monkeypatch):
    batch, found, kinds = make_batch(), [], []
    start = {name: buffer.clone() for name, buffer in module.net.named_buffers()}
    pool = parallel._pool
    monkeypatch.setattr(parallel, "_pool", lambda *kind: kinds.append(kind) or pool(*kind))
    for count in (1, 2, 3):
        threads(count)
        module.net.load_state_dict(start, strict=False)
        module.zero_grad()
        terms = module._parallel_scenes(batch)
        terms["loss"].backward()
        found.append(state(module) | terms)
        assert torch.get_num_threads() == count
    assert kinds == [(1, 1), (2, 1), (3, 1)]
    for other in found[1:]:
        assert other.keys() == found[0].keys()
        for name, tensor in found[0].items():
            assert torch.equal(tensor, other[name]), name


@pytest.mark.medium
def test_it_computes_under_autocast_where_its_caller_does(module):
    types = []

    def compute(batch, net):
        types.append((torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")))
        return {"loss": sum(p.sum() for p in net.parameters() if p.requires_grad)}

    scenes = ParallelScenes(module.net, compute)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        scenes(make_batch())
    scenes(make_batch())
    assert types[:SCENES] == [(True, torch.bfloat16)] * SCENES
    assert not any(enabled for enabled, _ in types[SCENES:])


def test_a_parameter_that_a_loss_does_not_see():
    net = nn.ModuleDict({"seen": nn.Linear(1, 1), "unseen": nn.Linear(1, 1)})
    scenes = ParallelScenes(net, lambda batch, net: {"loss": net["seen"].weight.sum()})
    scenes(make_batch())["loss"].backward()
    assert net["seen"].weight.grad == 1 and net["unseen"].weight.grad == 0


def test_an_error_in_a_scene_is_the_steps():
    def fail(batch, net):
        raise ValueError(batch["scene"][0])

    with pytest.raises(ValueError, match="scene 0"):
        ParallelScenes(nn.Linear(1, 1), fail)(make_batch())
