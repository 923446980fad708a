"""From photographs to Gaussians in Python: open, predict, render, write.

python examples/reconstruct_scene.py [my_scene]
"""

import sys
import tempfile
from pathlib import Path

from asysplat import open_photographs, predict, render, write_gaussians
from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms
from asysplat.evaluation.figures import comparison_figure
from asysplat.interrupts import handle_signals


def reconstruct(folder: Path, scene: Path, figure: Path) -> None:
    photographs = open_photographs(folder, height=128, width=128, views=8)
    gaussians = predict(photographs.inputs, seconds=10.0)
    world = photographs.normalization.to_world(gaussians)  # the world of the files
    write_gaussians(scene, world)

    rendering = render(gaussians, photographs.held_out.cameras, photographs.background)
    comparison_figure(photographs.inputs, photographs.held_out, rendering).savefig(figure, dpi=110)
    print(f"{gaussians.num_gaussians:,} Gaussians; scene: {scene}; figure: {figure}")


def write_synthetic(folder: Path) -> Path:
    """Write a synthetic scene in place of photographs."""
    scene = ProceduralScene(seed=7, height=128, width=128, num_images=24)
    write_transforms(scene.views(range(scene.num_images)), folder)
    return folder


if __name__ == "__main__":
    handle_signals()
    with tempfile.TemporaryDirectory() as empty:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else write_synthetic(Path(empty) / "scene")
        reconstruct(folder, Path("reconstructed.ply"), Path("reconstructed.png"))
