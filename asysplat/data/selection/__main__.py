"""Write an index of the frames that an evaluation uses.

python -m asysplat.data.selection path/to/scenes index.json --selection kmeans --inputs 32
"""

import argparse
import sys
from pathlib import Path

from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.selection import SELECTIONS, named_selection
from asysplat.data.selection.index import Entry, camera_hash, write_index
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
        entries = index_entries(
            options.root, options.layout, options.selection, options.inputs, options.targets
        )
        if options.index.resolve().is_relative_to(options.root.resolve()):
            raise InputError(f"{options.index} lies in the data set: name a file outside of it.")
        write_index(options.index, options.selection, entries)
    except InputError as error:
        sys.exit(f"error: {error}")
    print(f"{options.index}: {len(entries)} scenes")


def index_entries(
    root: Path, layout: str, selection: str, num_inputs: int, num_targets: int
) -> dict[str, Entry]:
    """Select the test frames of every scene that `root` is or holds.

    Raises:
        InputError: a scene that cannot be read, that is too short, or two of one name.
    """
    layout, scenes = find_scenes(root, layout)
    entries: dict[str, Entry] = {}
    for scene in scenes:
        sequence = open_scene(scene, 1, 1, layout)  # cameras alone: no pixel is read
        if sequence.name in entries:
            raise InputError(f"{root} holds two scenes called {sequence.name}: rename one.")
        chosen = named_selection(selection, sequence.cameras, num_inputs, num_targets, "test")
        entries[sequence.name] = Entry(chosen, camera_hash(sequence.cameras))
    return entries


if __name__ == "__main__":
    main()
