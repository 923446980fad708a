"""Write an index of the images that an evaluation uses.

python -m asysplat.data.selection path/to/scenes index.json --selection kmeans --inputs 32
"""

import argparse
import sys
from pathlib import Path

from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.selection import SELECTIONS, named_selection
from asysplat.data.selection.index import Entry, camera_hash, write_index
from asysplat.data.sequence import SceneOptions
from asysplat.errors import InputError


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m asysplat.data.selection")
    parser.add_argument("root", type=Path, help="a scene, or a folder of scenes")
    parser.add_argument("index", type=Path, help="the file to write, outside of the data set")
    parser.add_argument("--layout", default="auto")
    parser.add_argument("--selection", choices=SELECTIONS, default="kmeans")
    parser.add_argument("--inputs", type=int, default=32)
    parser.add_argument("--targets", type=int, default=8, help="of every_8th and uniform")
    options = parser.parse_args(arguments)
    try:
        entries = index_entries(options)
        if options.index.resolve().is_relative_to(options.root.resolve()):
            raise InputError(f"{options.index} lies in the data set: name a file outside of it.")
        write_index(options.index, options.selection, entries)
    except InputError as error:
        sys.exit(f"error: {error}")
    print(f"{options.index}: {len(entries)} scenes")


def index_entries(options: argparse.Namespace) -> dict[str, Entry]:
    """Select the test images of every scene that `root` is or holds."""
    layout, scenes = find_scenes(options.root, options.layout)
    entries: dict[str, Entry] = {}
    for scene in scenes:
        sequence = open_scene(scene, SceneOptions(1, 1, layout))  # reads cameras, no pixels
        if sequence.name in entries:
            raise InputError(f"{options.root} holds two scenes called {sequence.name}: rename one.")
        selection = named_selection(
            options.selection, sequence.cameras, options.inputs, options.targets, "test"
        )
        entries[sequence.name] = Entry(selection, camera_hash(sequence.cameras))
    return entries


if __name__ == "__main__":
    main()
