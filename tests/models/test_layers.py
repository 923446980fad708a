"""Checkpointing: the same step in less memory; and a whole network in float32 and float64."""

import pytest
import torch
from saved_tensors import saved_bytes
from test_asysplat import make_views

SMALL = ["width=0.125", "model.blocks.m.state_size=16", "model.layers=2m2s"]


def step(net, views):
    """Gaussians, gradients and running means."""
    net.train().zero_grad()
    gaussians = net(views)
    (gaussians.means.square().mean() + gaussians.sh.mean() + gaussians.opacities.mean()).backward()
    grads = [p.grad.clone() for p in net.parameters() if p.grad is not None]
    return [gaussians.means.detach(), gaussians.sh.detach(), *grads, *net.buffers()]


@pytest.mark.medium
def test_checkpointing_changes_nothing_but_memory(build):
    torch.manual_seed(0)
    net, views = build(*SMALL), make_views(batch=(1,), width=48)
    start = {name: value.clone() for name, value in net.state_dict().items()}
    plain = [tensor.clone() for tensor in step(net, views)]
    again = build(*SMALL)
    again.load_state_dict(start)
    again.checkpoint_layers(True)
    assert all(map(torch.equal, step(again, views), plain))
    _, whole = saved_bytes(net, lambda: net(views))
    _, less = saved_bytes(again, lambda: again(views))
    assert less < 0.5 * whole


@pytest.mark.medium
@pytest.mark.parametrize("model", ["asysplat_4m4s", "asysplat_7m1t"])
def test_float32_gives_the_gaussians_of_float64(build, model):
    torch.manual_seed(0)
    net = build("width=0.125", f"model={model}").eval()
    views = make_views(batch=(1,), views=4, height=64, width=64)
    with torch.no_grad():
        single = net(views)
        exact = net.double()(views.to(torch.float64))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        value, truth = getattr(single, name).double(), getattr(exact, name)
        assert truth.dtype == torch.float64
        assert (value - truth).norm() <= 1e-4 * truth.norm(), name
        assert (value - truth).abs().max() <= 1e-4 * truth.abs().max(), name
