"""Index files, which name the images of each scene: pixelSplat's, Long-LRM's, and our own.

https://github.com/dcharatan/pixelsplat/blob/main/assets/evaluation_index_re10k.json
https://github.com/arthurhero/Long-LRM/tree/main/data/example_data
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asysplat.data.readers.common import folders_with, read_frames, read_json
from asysplat.data.selection.kmeans import DECIMALS, pose_features
from asysplat.data.selection.views import Selection
from asysplat.errors import InputError
from asysplat.scene import Cameras

LONG_LRM_FILE = "opencv_cameras.json"
LONG_LRM_LIST = re.compile(r"fold_(\d+)_kmeans_(\d+)_input")


# Scene -> its selection, and the hash of its cameras where the index has one.
Index = Mapping[str, tuple[Selection, str | None]]


def read_index(path: Path | str, num_inputs: int) -> Index:
    """Read an index of any of the three forms.

    pixelSplat's: {scene: {"context": [...], "target": [...]} or null}; scenes that are null are
    left out, and a target may be an input. Long-LRM's: a scene's own opencv_cameras.json with a
    list `fold_8_kmeans_32_input`, where every 8th image is a target; for many scenes, their folder.
    Ours: see `write_index`.

    Raises:
        InputError: none of these, a list for another number of inputs, or an index of ours that
            was changed.
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
    if not isinstance(content, dict):
        raise InputError(f'{path} is no index: give {{"scene": {{"context": [], "target": []}}}}.')
    if isinstance(content.get("frames"), list):
        return dict([_long_lrm_entry(path, content, num_inputs)])
    scenes = content
    if "hash" in content:
        stored = {name: value for name, value in content.items() if name != "hash"}
        if content["hash"] != _hash_of(stored) or not isinstance(content.get("scenes"), dict):
            raise InputError(f"{path} was changed after it was written: write it again.")
        scenes = content["scenes"]
    index = {}
    for name, stored in scenes.items():
        if stored is not None:
            entry = stored if isinstance(stored, dict) else {}
            where = f"{path}, scene {name}"
            lists = (_indices(f"{where}, {key}", entry.get(key)) for key in ("context", "target"))
            index[name] = Selection(*lists), entry.get("cameras")
    return index


def selection_of(
    index: Index, path: Path | str, scene: str, cameras: Cameras, num_inputs: int
) -> Selection:
    """Return the selection of a scene in the index that was read from `path`.

    Raises:
        InputError: the index was made for other cameras or another number of inputs, or names an
            image that the scene lacks.
    """
    selection, made_for = index[scene]
    where = f"{path}, scene {scene}"
    if made_for not in (None, camera_hash(cameras)):
        raise InputError(
            f"{where}: the index was made for other cameras: write it again for these files."
        )
    if len(selection.inputs) != num_inputs:
        raise InputError(
            f"{where} has {len(selection.inputs)} inputs and data.inputs is {num_inputs}: set one "
            "to the other."
        )
    last = max(selection.inputs + selection.targets)
    if last >= cameras.num_views:
        raise InputError(
            f"{where} names image {last}, and the scene has {cameras.num_views} images: it belongs "
            "to another version of the scene; write the index again for this one."
        )
    return selection


def write_index(path: Path, method: str, index: Index) -> None:
    """Write an index in our own form, with a hash over all of it that reveals later changes.

    Raises:
        InputError: the file exists.
    """
    if path.exists():
        raise InputError(f"{path} exists: name a new file, nothing is overwritten.")
    scenes = {
        name: {"context": selection.inputs, "target": selection.targets, "cameras": made_for}
        for name, (selection, made_for) in index.items()
    }
    content = {"selection": method, "scenes": scenes}
    path.write_text(json.dumps(content | {"hash": _hash_of(content)}, indent=1))


def camera_hash(cameras: Cameras) -> str:
    """Hash the cameras' positions and viewing directions, for any origin and unit."""
    steps = (pose_features(cameras) * 10**DECIMALS).round().astype("<i8")
    return hashlib.blake2b(np.ascontiguousarray(steps).tobytes(), digest_size=16).hexdigest()


def _hash_of(content: dict[str, Any]) -> str:
    data = json.dumps(content, sort_keys=True).encode()
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def _long_lrm_entry(
    file: Path, content: dict[str, Any], num_inputs: int
) -> tuple[str, tuple[Selection, None]]:
    lists = {name: matched for name in content if (matched := LONG_LRM_LIST.fullmatch(name))}
    for name, matched in lists.items():
        fold, count = map(int, matched.groups())
        if count == num_inputs and fold > 0:
            inputs = _indices(f"{file}, {name}", content[name])
            selection = Selection(inputs, list(range(0, len(content["frames"]), fold)))
            return str(content.get("scene_name", file.parent.name)), (selection, None)
    raise InputError(
        f"{file} has no list fold_8_kmeans_{num_inputs}_input (its lists: "
        f"{', '.join(lists) or 'none'}): set data.inputs to the number of a list, or use "
        "data.selection=kmeans."
    )


def _indices(where: str, stored: Any) -> list[int]:
    valid = isinstance(stored, list) and stored and all(type(n) is int and n >= 0 for n in stored)
    if not valid or len(set(stored)) != len(stored):
        raise InputError(f"{where} is {stored!r}: give a list of different image numbers from 0.")
    return stored
