"""Write an index of the images that an evaluation uses.

python -m asysplat.data.selection path/to/scenes index.json --selection kmeans --inputs 32
"""

import argparse
import sys
from pathlib import Path

from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.selection import SELECTIONS, Selection, named_selection
from asysplat.data.selection.index import write_index
from asysplat.data.sequence import SceneOptions
from asysplat.data.write import refuse_inside
from asysplat.errors import InputError
from asysplat.interrupts import handle_signals


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m asysplat.data.selection")
    parser.add_argument("root", type=Path, help="a scene, or a folder of scenes")
    parser.add_argument("index", type=Path, help="the file to write, outside of the data set")
    parser.add_argument("--layout", default="auto")
    parser.add_argument("--selection", choices=SELECTIONS, default="kmeans")
    parser.add_argument("--inputs", type=int, default=32)
    parser.add_argument("--targets", type=int, default=8, help="number, for every_8th and uniform")
    options = parser.parse_args(arguments)
    index: dict[str, Selection] = {}
    try:
        layout, scenes = find_scenes(options.root, options.layout)
        refuse_inside(options.index, options.root, "name a file outside of it")
        for scene in scenes:
            sequence = open_scene(scene, SceneOptions(1, 1, layout))  # reads cameras, no pixels
            name = sequence.name
            if name in index:
                raise InputError(f"{options.root} holds two scenes called {name}: rename one.")
            rest = (options.inputs, options.targets, "test", sequence.scene.held_out)
            index[name] = named_selection(options.selection, sequence.cameras, *rest)
        write_index(options.index, index)
    except InputError as error:
        sys.exit(f"error: {error}")
    print(f"{options.index}: {len(index)} scenes")


if __name__ == "__main__":
    handle_signals()
    main()
