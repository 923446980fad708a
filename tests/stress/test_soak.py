"""Long runs: make slow.

python tests/stress/test_soak.py path/to/scene 1000 refines a scene: every gradient is finite, and
the result is drawn the same again; with NUMBA_BOUNDSCHECK=1 in poisoned memory.
python tests/stress/test_soak.py render measures the memory that a thousand calls leave behind.
"""

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest
import torch
from backends import FAST, assert_same_bits, both_ways
from poison import FILLS, poisoned

from asysplat import Gaussians, Views, load, open_photographs, refine, render
from asysplat.data import ProceduralScene
from asysplat.evaluation.metrics import mean_color_images, psnr
from asysplat.refinement import DEFAULT
from asysplat.refinement.init import initial_gaussians

SIDE = 256  # pixels
SCENES = ("fern", "fox", "mydesk", "hololens-000")
CHECKED = {"NUMBA_BOUNDSCHECK": "1", "GLIBC_TUNABLES": "glibc.malloc.perturb=128"}

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]


def run(command: list[str], cwd: Path, extra: dict[str, str]) -> str:
    environment = {**os.environ, **extra}
    done = subprocess.run(
        [sys.executable, *command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.strip().splitlines()[-1]


@pytest.mark.parametrize("extra", [{}, CHECKED], ids=["plain", "checked"])
@pytest.mark.parametrize("scene", SCENES)
def test_a_thousand_steps_of_all_fields(shared, repository, scene, extra):
    print(run([__file__, str(shared / "data" / scene), "1000"], repository, extra))


@pytest.mark.parametrize("call", ["render", "refine", "load"])
def test_memory_stays_flat_over_a_thousand_calls(repository, call):
    grown = json.loads(run([__file__, call], repository, {}))
    print(f"{call}: {grown} MB from the 200th to the 1,000th call")
    assert grown < 20


def memory_growth(call: str) -> float:
    """Measure by how many MB this process grows from the 200th to the 1,000th call."""
    views = ProceduralScene(0, 48, 64, 4).views(range(4))
    gaussians = load("shipped")(views)
    gaussians = gaussians.keep(torch.arange(gaussians.num_gaussians) % 50 == 0)
    calls = {
        "render": lambda: render(gaussians, views.cameras),
        "refine": lambda: refine(gaussians, views, steps=1),
        "load": lambda: load("shipped"),
    }
    sizes = []
    for number in range(1000):
        calls[call]()
        if number % 100 >= 90:  # it takes longer than a call
            gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        sizes.append(pages * os.sysconf("SC_PAGESIZE") / 1e6)
    return round(max(sizes[-10:]) - max(sizes[190:200]), 1)


def refine_and_draw(views: Views, start: Gaussians, steps: int) -> Gaussians:
    non_finite = []

    def watch(_, refinement) -> bool:
        non_finite.append(refinement.fields.optimizer.non_finite)
        return False

    found = refine(start, views, steps=steps, watch=watch).validate()
    assert len(non_finite) == steps and non_finite[-1] == 0
    runs = [both_ways(FAST[0], found, views.cameras.map(lambda t: t[:2])) for _ in range(2)]
    assert_same_bits(*runs)
    assert runs[0].stats == runs[1].stats
    return found


if __name__ == "__main__" and len(sys.argv) == 2:
    print(memory_growth(sys.argv[1]))
elif __name__ == "__main__":
    scene, steps = sys.argv[1], int(sys.argv[2])
    checked = numba.config.BOUNDSCHECK
    with poisoned(FILLS[0] if checked else None):
        photographs = open_photographs(scene, SIDE, SIDE, held_out_every=None)
        views = photographs.inputs
        start = initial_gaussians("plane_sweep", photographs.inputs, DEFAULT)
        end = refine_and_draw(views, start, steps)
        images = [render(gaussians, views.cameras).image for gaussians in (start, end)]
    images.append(mean_color_images(views, views))
    before, after, flat = (psnr(image, views.images).mean().item() for image in images)
    print(f"{scene}: {steps} steps, {before:.2f} to {after:.2f} dB, flat {flat:.2f} dB")
    assert after > before + 1 and after > flat + 1
