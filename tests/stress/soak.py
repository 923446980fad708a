"""A scene refined for long, as a user would: every gradient is finite, and the result is drawn the
same again.

python tests/stress/soak.py path/to/scene 1000
NUMBA_BOUNDSCHECK=1 python tests/stress/soak.py path/to/scene 1000, with memory poisoned too
"""

import sys

import numba
from backends import FAST, assert_same_bits, both_ways
from poison import FILLS, poisoned

from asysplat import Gaussians, Views, open_photographs, refine, render
from asysplat.evaluation.baselines import BASELINES
from asysplat.evaluation.metrics import psnr
from asysplat.refinement import RefinementSettings
from asysplat.refinement.init import initial_gaussians

SIDE = 256  # pixels


def soak(views: Views, start: Gaussians, steps: int) -> Gaussians:
    non_finite = []

    def watch(_, refinement) -> bool:
        non_finite.append(refinement.fields.optimizer.non_finite)
        return False

    found = refine(start, views, steps=steps, watch=watch).validate()
    assert len(non_finite) == steps and non_finite[-1] == 0
    cpu = next(backend for backend in FAST if backend.name == "cpu")
    runs = [both_ways(cpu, found, views.cameras.map(lambda t: t[:2])) for _ in range(2)]
    assert_same_bits(*runs)
    assert runs[0].stats == runs[1].stats
    return found


if __name__ == "__main__":
    scene, steps = sys.argv[1], int(sys.argv[2])
    checked = numba.config.BOUNDSCHECK
    with poisoned(FILLS[0] if checked else None):
        photographs = open_photographs(scene, SIDE, SIDE, held_out_every=None)
        views = photographs.inputs
        start = initial_gaussians("plane_sweep", photographs, RefinementSettings().max_gaussians)
        end = soak(views, start, steps)
        images = [render(gaussians, views.cameras).image for gaussians in (start, end)]
    flat = BASELINES["mean_color"](views, views)
    before, after, flat = (psnr(image, views.images).mean().item() for image in (*images, flat))
    kind = " with checks, in poisoned memory" if checked else ""
    print(f"{scene}: {steps} steps{kind}, {before:.2f} to {after:.2f} dB, flat {flat:.2f} dB")
    assert after > before + 1 and after > flat + 1
