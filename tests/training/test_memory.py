"""Options that save memory change no gradient."""

import ctypes
import gc

import pytest
import torch
from saved_tensors import saved_bytes
from test_parallel_scenes import make_batch, module  # noqa: F401

from asysplat.evaluation.measured_cost import peak_memory_gb, reset_peak_memory
from asysplat.rendering import render
from asysplat.training import SplattingLoss


def step(module):  # noqa: F811
    """The gradients of a step that renders two views of three scenes, and what autograd keeps."""
    batch = make_batch()
    batch["targets"] = batch["inputs"]
    module.zero_grad()
    terms, kept = saved_bytes(module, lambda: module.scene_terms(batch, module.net))
    terms["loss"].backward()
    return torch.cat([p.grad.flatten() for p in module.parameters() if p.requires_grad]), kept


def test_the_same_gradients_in_less_memory(module):  # noqa: F811
    module.loss = SplattingLoss(mse=1.0, perceptual=0.0, depth=0.1, ssim=0.1)
    expected, whole = step(module)
    # What the renderer keeps autograd does not see: the next test measures it.
    for views_at_once, checkpointing, most in ((1, False, 1.0), (None, True, 0.8), (1, True, 0.8)):
        module.views_at_once = views_at_once
        module.net.checkpoint_layers(checkpointing)
        found, less = step(module)
        assert (found - expected).norm() <= 1e-6 * expected.norm() > 0
        assert less < most * whole


@pytest.mark.medium
@pytest.mark.skipif(not reset_peak_memory("cpu"), reason="the peak cannot be reset")
def test_views_at_once_bound_the_memory_of_rendering(make_scene):
    gaussians, cameras = make_scene(count=40_000, views=8, dtype=torch.float32)
    risen = {}
    for views_at_once in (1, None):
        leaves = gaussians.map(lambda tensor: tensor.clone().requires_grad_())
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # work that reuses freed memory would not raise the peak
        reset_peak_memory("cpu")
        before = peak_memory_gb("cpu")
        render(leaves, cameras, views_at_once=views_at_once).image.sum().backward()
        risen[views_at_once] = peak_memory_gb("cpu") - before
    print(f"\nGB to render 8 views: {risen[None]:.3f}, one at a time {risen[1]:.3f}")
    assert risen[1] < 0.6 * risen[None]
