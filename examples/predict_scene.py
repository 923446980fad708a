"""Predict Gaussians with a network and render target views, without Lightning.

python examples/predict_scene.py [logs/demo/.../checkpoints/best.ckpt] [figure.png]
"""

import sys
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from asysplat import render
from asysplat.data import ProceduralScene
from asysplat.evaluation.figures import comparison_figure

CONF = Path(__file__).resolve().parents[1] / "conf"


def build(*overrides: str) -> torch.nn.Module:
    """Build the network that `python train.py` would train with these overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return instantiate(compose("train", list(overrides)).model)


@torch.no_grad()
def main(checkpoint: Path | None, figure: Path) -> None:
    net = build("model=asysplat_4m4s", "scale=laptop").eval()
    if checkpoint is not None:
        state = torch.load(checkpoint, weights_only=True)["state_dict"]
        net.load_state_dict({k.removeprefix("net."): v for k, v in state.items() if "net." in k})
    scene = ProceduralScene(seed=5, height=64, width=64)
    inputs, targets = scene.views(range(0, 48, 6)), scene.views([9, 21, 33])
    gaussians = net(inputs)
    rendering = render(gaussians, targets.cameras, background=torch.full((3,), 0.5))
    comparison_figure(inputs, targets, rendering).savefig(figure, dpi=120)
    print(f"{gaussians.num_gaussians:,} Gaussians; figure: {figure}")


if __name__ == "__main__":
    words = [Path(word) for word in sys.argv[1:]]
    main(
        next((path for path in words if path.suffix == ".ckpt"), None),
        next((path for path in words if path.suffix == ".png"), Path("predict_scene.png")),
    )
