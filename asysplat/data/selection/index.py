"""Index files, which name the images of each scene, in pixelSplat's form and in Long-LRM's.

ZipSplat's indices have pixelSplat's form; that is why ours are written in it.

https://github.com/dcharatan/pixelsplat/blob/main/assets/evaluation_index_re10k.json
https://github.com/cvg/ZipSplat/tree/main/splatfactory/eval/indices
https://github.com/arthurhero/Long-LRM/tree/main/data/example_data
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asysplat.data.readers.common import folders_with, read_frames
from asysplat.data.selection import Selection
from asysplat.errors import InputError
from asysplat.files import read_json

KEYS = ("context", "target")  # of pixelSplat's form
LONG_LRM_FILE = "opencv_cameras.json"
LONG_LRM_LIST = re.compile(r"fold_(\d+)_kmeans_(\d+)_input")


@dataclass(frozen=True)
class Entry:
    """A scene's inputs and targets; a number stands for every so many images as targets."""

    inputs: list[int]
    targets: list[int] | int


def read_index(path: Path | str, num_inputs: int) -> dict[str, Entry]:
    """Read an index of either form: scene -> entry.

    pixelSplat's: {scene: {"context": [...], "target": [...]} or null, which is left out}.
    Long-LRM's: a list of {"scene_name": ..., "fold_8_kmeans_32_input": [...]}, where every 8th
    image is a target; or a scene's own opencv_cameras.json with such a list; or a folder of scenes.
    """
    path = Path(path)
    if path.is_dir():
        files = [folder / LONG_LRM_FILE for folder in folders_with(path, LONG_LRM_FILE)]
        if not files:
            raise InputError(
                f"data.index={path} is a folder without {LONG_LRM_FILE}: name an index file, or "
                "scenes in the layout of Long-LRM."
            )
        return dict(_long_lrm_entry(file, read_frames(file), num_inputs) for file in files)
    content = read_json(path)
    if isinstance(content, list):
        return dict(_long_lrm_entry(path, entry, num_inputs) for entry in content)
    if "frames" in content:
        return dict([_long_lrm_entry(path, content, num_inputs)])
    return {
        name: Entry(*(_indices(f"{path}, scene {name}, {key}", stored.get(key)) for key in KEYS))
        for name, stored in content.items()
        if stored is not None
    }


def select_from_index(
    index: Mapping[str, Entry], path: Path | str, scene: str, num_images: int, num_inputs: int
) -> Selection:
    """Look up the selection of a scene in the index that was read from `path`."""
    entry, where = index[scene], f"{path}, scene {scene}"
    if len(entry.inputs) != num_inputs:
        raise InputError(
            f"{where} has {len(entry.inputs)} inputs and data.inputs is {num_inputs}: set one "
            "to the other."
        )
    targets = entry.targets
    if isinstance(targets, int):
        targets = list(range(0, num_images, targets))
    last = max(entry.inputs + targets)
    if last >= num_images:
        raise InputError(
            f"{where} names image {last}, and the scene has {num_images} images: it belongs "
            "to another version of the scene; write the index again for this one."
        )
    return Selection(entry.inputs, targets)


def write_index(path: Path, index: Mapping[str, Selection]) -> None:
    """Write an index in pixelSplat's form."""
    if path.exists():
        raise InputError(f"{path} exists: name a new file, nothing is overwritten.")
    scenes = {name: {"context": s.inputs, "target": s.targets} for name, s in index.items()}
    path.write_text(json.dumps(scenes, indent=1))


def _long_lrm_entry(file: Path, content: dict[str, Any], num_inputs: int) -> tuple[str, Entry]:
    lists = {name: matched for name in content if (matched := LONG_LRM_LIST.fullmatch(name))}
    scene = str(content.get("scene_name", file.parent.name))
    for name, matched in lists.items():
        fold, count = map(int, matched.groups())
        if count == num_inputs and fold > 0:
            return scene, Entry(_indices(f"{file}, scene {scene}, {name}", content[name]), fold)
    raise InputError(
        f"{file}, scene {scene} has no list fold_8_kmeans_{num_inputs}_input (its lists: "
        f"{', '.join(lists) or 'none'}): set data.inputs to the number of a list, or use "
        "data.selection=kmeans."
    )


def _indices(where: str, stored: Any) -> list[int]:
    if not stored or len({*stored}) != len(stored) or min(stored) < 0:
        raise InputError(f"{where} is {stored!r}: give a list of different image numbers from 0.")
    return stored
