"""Where scenes lie below the folder that a user names."""

import re
from pathlib import Path

DEPTH = 3  # folders between the named one and a scene, as DL3DV has with its parts and hashes


def folders_with(root: Path, *marks: str) -> list[Path]:
    """`root` if one of the files `marks` lies there, else such folders nearest below it, sorted."""
    level = [root] if root.is_dir() else []
    for _ in range(DEPTH + 1):
        found = [folder for folder in level if any((folder / mark).exists() for mark in marks)]
        if found:
            return found
        level = sorted(child for folder in level for child in folder.iterdir() if child.is_dir())
    return []


def natural_order(path: Path) -> list[str | int]:
    """A sort key: by the numbers in the name, 2 before 10."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [int(part) if part.isdecimal() else part for part in parts]
