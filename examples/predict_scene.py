"""Predict Gaussians with a model and render target views, without Lightning.

python examples/predict_scene.py [logs/demo/.../checkpoints/last.ckpt] [figure.png]
"""

import sys
from pathlib import Path

import torch

from asysplat import load, render
from asysplat.data import ProceduralScene
from asysplat.data.normalize import normalize
from asysplat.evaluation.figures import comparison_figure
from asysplat.interrupts import handle_signals


@torch.no_grad()
def main(checkpoint: Path | None, figure: Path) -> None:
    net = load("shipped" if checkpoint is None else str(checkpoint))
    scene = ProceduralScene(seed=5, height=64, width=64)
    inputs, targets = scene.views(range(0, 48, 6)), scene.views([9, 21, 33])
    inputs, targets, _ = normalize(inputs, targets)
    gaussians = net(inputs)
    rendering = render(gaussians, targets.cameras, background=torch.full((3,), 0.5))
    comparison_figure(inputs, targets, rendering).savefig(figure, dpi=120)
    print(f"{gaussians.num_gaussians:,} Gaussians; figure: {figure}")


if __name__ == "__main__":
    handle_signals()
    words = [Path(word) for word in sys.argv[1:]]
    main(
        next((path for path in words if path.suffix == ".ckpt"), None),
        next((path for path in words if path.suffix == ".png"), Path("predict_scene.png")),
    )
