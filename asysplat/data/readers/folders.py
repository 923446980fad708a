"""Where scenes lie below the folder that a user names."""

import os
import re
from pathlib import Path

DEPTH = 3  # folders between the named one and a scene, as DL3DV has with its parts and hashes


def folders_with(root: Path, *marks: str, depth: int = DEPTH) -> list[Path]:
    """`root` if one of the files `marks` lies there, else all such folders below it, sorted; what
    lies within one of them is its own."""
    if not root.is_dir():
        return []
    if any((root / mark).exists() for mark in marks):
        return [root]
    if depth == 0:
        return []
    with os.scandir(root) as entries:  # which, unlike Path, knows folders without asking again
        folders = sorted(entry.path for entry in entries if entry.is_dir())
    return [
        scene for folder in folders for scene in folders_with(Path(folder), *marks, depth=depth - 1)
    ]


def natural_order(path: Path) -> list[str | int]:
    """A sort key: by the numbers in the name, 2 before 10."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [int(part) if part.isdecimal() else part for part in parts]
