"""JSON files of a scene."""

import json
from pathlib import Path
from typing import Any

from asysplat.errors import InputError


def read_json(file: Path) -> Any:
    """What a JSON file holds.

    Raises:
        InputError: the file is missing, empty or not JSON.
    """
    if not file.is_file():
        raise InputError(f"{file} does not exist: put it there, or name another file.")
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    if not text.strip():
        raise InputError(f"{file} is empty: write it again.")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{file} is not JSON ({error}): repair or write it again.") from error
