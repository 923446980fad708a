"""A scene optimized for long, as a user would: all fields of 60,000 Gaussians, on photographs.

python tests/stress/soak.py path/to/scene 1000
NUMBA_BOUNDSCHECK=1 python tests/stress/soak.py path/to/scene 1000, with memory poisoned too
"""

import sys
from pathlib import Path

import numba
import numpy as np
import torch
from backends import FAST, assert_same_bits, both_ways
from poison import FILLS, poisoned
from rich.progress import track
from torch import Tensor

from asysplat import Gaussians, Views, render
from asysplat.data import SceneOptions, open_scene
from asysplat.data.normalize import normalize
from asysplat.evaluation.metrics import psnr
from asysplat.rendering.sh import SH_C0

SIDE = 256  # pixels
COUNT = 60_000
MAX_VIEWS = 32
SH_COUNT = 4
RATES = {"means": 1e-3, "quats": 1e-2, "scales": 1e-2, "opacities": 3e-2, "sh": 1e-2}


def photographs(scene: Path) -> Views:
    """Open views of a scene, in the frame of networks."""
    sequence = open_scene(scene, SceneOptions(SIDE, SIDE))
    count = min(MAX_VIEWS, sequence.num_images)
    views = sequence.views(np.linspace(0, sequence.num_images - 1, count).astype(int).tolist())
    return normalize(views, views)[0]


def start(views: Views) -> dict[str, Tensor]:
    """Gaussians on the rays of all views, at a distance of about 2, in the photographs' colors."""
    side = round((COUNT / views.num_views) ** 0.5)
    origins, directions = views.cameras.resized(side, side).rays()
    distance = 2 * (0.3 * torch.randn(*directions.shape[:-1], 1)).exp()
    means = (origins + distance * directions).reshape(-1, 3)
    pixel = distance.reshape(-1, 1) * views.cameras.width / side
    pixel = pixel / views.cameras.intrinsics[0, 0, 0]
    small = torch.nn.functional.adaptive_avg_pool2d(views.images, side)
    colors = small.permute(0, 2, 3, 1).reshape(-1, 1, 3)
    sh = torch.zeros(len(means), SH_COUNT, 3)
    sh[:, :1] = (colors - 0.5) / SH_C0
    fields = {
        "means": means,
        "quats": torch.randn(len(means), 4),
        "scales": pixel.log().expand(-1, 3) + 0.3 * torch.randn(len(means), 3),
        "opacities": torch.zeros(len(means)),
        "sh": sh,
    }
    return {name: tensor.clone().requires_grad_() for name, tensor in fields.items()}


def activated(fields: dict[str, Tensor]) -> Gaussians:
    scales, opacities = fields["scales"].exp(), fields["opacities"].sigmoid()
    return Gaussians(fields["means"], fields["quats"], scales, opacities, fields["sh"])


def soak(views: Views, steps: int) -> tuple[float, float]:
    """PSNR of all views before and after; every step's loss and gradients are finite."""
    fields = start(views)
    groups = [{"params": [tensor], "lr": RATES[name]} for name, tensor in fields.items()]
    optimizer = torch.optim.Adam(groups, eps=1e-15)

    @torch.no_grad()
    def quality() -> float:
        return psnr(render(activated(fields), views.cameras).image, views.images).mean().item()

    before = quality()
    for step in track(range(steps), "soak", disable=not sys.stderr.isatty()):
        view = [step % views.num_views]
        seen = views.select(view)
        out = render(activated(fields), seen.cameras)
        loss = (out.image - seen.images).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        assert loss.isfinite(), f"step {step}: the loss is {loss.item()}"
        for name, tensor in fields.items():
            assert tensor.grad.isfinite().all(), f"step {step}: the gradient of {name}"
        optimizer.step()
    after = quality()
    # What a long run has made of them is drawn the same again.
    scene = activated({name: tensor.detach() for name, tensor in fields.items()})
    cpu = next(backend for backend in FAST if backend.name == "cpu")
    runs = [both_ways(cpu, scene, views.cameras.map(lambda t: t[:2])) for _ in range(2)]
    assert_same_bits(*runs)
    assert runs[0].stats == runs[1].stats
    return before, after


if __name__ == "__main__":
    scene, steps = Path(sys.argv[1]), int(sys.argv[2])
    torch.manual_seed(0)
    checked = numba.config.BOUNDSCHECK
    with poisoned(FILLS[0] if checked else None):
        views = photographs(scene)
        before, after = soak(views, steps)
    mean = views.images.mean((0, 2, 3))[:, None, None].expand_as(views.images)
    flat = psnr(mean, views.images).mean().item()
    kind = " with checks, in poisoned memory" if checked else ""
    print(f"{scene.name}: {steps} steps{kind}, {before:.2f} to {after:.2f} dB, flat {flat:.2f} dB")
    assert after > before + 1 and after > flat + 1
