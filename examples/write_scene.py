"""Write a synthetic scene to disk, in place of your photographs.

python examples/write_scene.py my_scene
"""

import sys
from pathlib import Path

from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms


def main(folder: Path) -> None:
    scene = ProceduralScene(seed=7, height=256, width=256, num_images=48)
    write_transforms(scene.views(range(scene.num_images)), folder)
    print(f"{scene.num_images} photographs, their cameras and depths: {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "my_scene"))
