"""Layers as `torch.compile` makes them: whole, and with the same numbers."""

import subprocess
import sys

import pytest
import torch

from asysplat.models.layers import Layers
from asysplat.training import SplattingLoss, SplattingModule
from asysplat.training.optimizers import cosine

SCRIPT = """
import torch
from asysplat.models import BiMamba2, FullAttention, MambaVision, SparseAttention, StageShape

shape = StageShape(64, 32, 2)
for build in (BiMamba2, SparseAttention, FullAttention, MambaVision):
    layer = build(shape)
    tokens = torch.randn(1, 2, 4, 4, 64)
    torch._dynamo.reset()
    explained = torch._dynamo.explain(layer)(tokens)
    assert explained.graph_count == 1 and explained.graph_break_count == 0, type(layer)
    torch._dynamo.reset()
    results = []
    for run in (layer, torch.compile(layer, backend="aot_eager", dynamic=False)):
        output = run(tokens)
        grads = torch.autograd.grad(output.square().sum(), list(layer.parameters()))
        results.append((output, *grads))
    for plain, compiled in zip(*results, strict=True):
        torch.testing.assert_close(plain, compiled)
    print(type(layer).__name__)
"""


@pytest.mark.medium
def test_every_layer_is_one_graph_with_the_same_gradients(repository):
    """In a process of its own: the tests' type checks break graphs."""
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True)
    names = ["BiMamba2", "SparseAttention", "FullAttention", "MambaVision"]
    assert done.stdout.split() == names, done.stderr


@pytest.mark.medium
def test_the_option_compiles_every_layer(build):
    net = build("width=0.125", "state_size=8", "model=asysplat_4m4s", device="meta")
    parts = {"loss": SplattingLoss(mse=1.0, perceptual=0.0, depth=0.0), "background": "inputs"}
    parts |= {"optimizer": torch.optim.SGD, "schedule": cosine}
    for compiled in (False, True):
        SplattingModule(net, **parts, compile=compiled)
        layers = [layer for group in net.modules() if isinstance(group, Layers) for layer in group]
        assert len(layers) > 8
        assert all((layer._compiled_call_impl is not None) is compiled for layer in layers)
