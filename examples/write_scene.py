"""Write a synthetic scene to disk, in place of your photographs.

python examples/write_scene.py my_scene
"""

from argparse import ArgumentParser
from pathlib import Path

if __name__ == "__main__":  # now, since torch takes seconds
    parser = ArgumentParser(description="Write a synthetic scene to disk.")
    parser.add_argument("folder", type=Path, nargs="?", default="my_scene", help="to write to")
    arguments = parser.parse_args()

from rich.progress import track

from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms
from asysplat.interrupts import handle_signals
from asysplat.scene import Views


def main(folder: Path) -> None:
    scene = ProceduralScene(seed=7, height=256, width=256, num_images=48)
    frames = [scene.views([index]) for index in track(range(scene.num_images), "rendering")]
    write_transforms(Views.stack(frames).map(lambda tensor: tensor[:, 0]), folder)
    print(f"{scene.num_images} photographs, their cameras and depths: {folder}")


if __name__ == "__main__":
    handle_signals()
    main(arguments.folder)
