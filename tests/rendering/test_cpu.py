"""The CPU backend on other machines, and in forked processes."""

import os
import subprocess
import sys

import pytest

PLAIN = """
import torch
from benchmarks.scenes import random_scene
from asysplat.rendering import render
from asysplat.rendering.cpu.rasterize import rasterize

gaussians, cameras = random_scene(300, 40, 50)
leaves = gaussians.map(lambda t: t.requires_grad_())
out = render(leaves, cameras, backend="cpu", depth=False)
exact = render(leaves.to(torch.float64), cameras.to(torch.float64), depth=False)
assert (out.image - exact.image).abs().max() < 1e-6
grads = [torch.autograd.grad(x.image.square().sum(), leaves.means)[0] for x in (out, exact)]
assert (grads[0] - grads[1]).norm() < 5e-6 * grads[1].norm()
assert "zmm" not in next(iter(rasterize.inspect_asm().values()))
"""
FORKED = """
import multiprocessing, torch
from asysplat import load, render
from asysplat.data import ProceduralScene
torch.set_num_threads(2)
views, network = ProceduralScene(1, 64, 64, 8).views(range(4)), load(None)

with torch.no_grad():
    expected = network(views)  # on two threads
    image = render(expected, views.cameras).image
context = multiprocessing.get_context("fork")
queue = context.SimpleQueue()
def child():
    same = torch.equal(render(expected, views.cameras).image, image)
    gaussians = network(views)
    gaussians.means.sum().backward()
    queue.put((same, (gaussians.means.detach() - expected.means).abs().max().item()))
process = context.Process(target=child, daemon=True)
process.start()
process.join(60)
assert process.exitcode == 0, process.exitcode
same, error = queue.get()
assert same and error < 1e-4, (same, error)
"""


@pytest.mark.slow  # it compiles all kernels
@pytest.mark.skipif(sys.platform != "linux", reason="names the instructions of an x86 processor")
def test_without_avx512_it_is_as_exact(tmp_path):
    if "x86_64" not in os.uname().machine:
        pytest.skip("names the instructions of an x86 processor")
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": "haswell",
        "NUMBA_CPU_FEATURES": "+avx,+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt,+sse4.2",
        "NUMBA_CACHE_DIR": str(tmp_path),
    }
    done = subprocess.run([sys.executable, "-c", PLAIN], env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.medium
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_draws_predicts_and_trains_too():
    """Although the threads of its parent stay behind, for which it would wait forever."""
    done = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, timeout=200)
    assert done.returncode == 0, done.stderr.decode()
