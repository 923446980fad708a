"""JSON inside of binary formats: objects whose keys are checked one by one as they are read."""

import json
import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from asysplat.errors import InputError

MAX_TEXT = 80  # characters of a value in a message
MAX_NUMBER = 1e30  # what is larger overflows float32 in products


class JsonRecord(NamedTuple):
    """A JSON object of a file.

    Args:
        path: the file.
        name: the object's, for messages.
        values: the object.
    """

    path: Path
    name: str
    values: dict[str, Any]

    def value(
        self, key: str, valid: Callable[[Any], bool], expected: str, default: Any = None
    ) -> Any:
        """Return the value of a key, or the default where it is absent."""
        found = self.values.get(key, default)
        if not valid(found):
            text = "no" if found is None else f"the value {reprlib.repr(found)[:MAX_TEXT]} as"
            raise InputError(
                f"{self.path} has {text} {key} in its {self.name}: expected {expected}; write it "
                "again."
            )
        return found

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """Return an integer in [low, high]."""
        return self.value(
            key,
            lambda found: type(found) is int and low <= found <= high,
            f"an integer from {low} to {high}",
            default,
        )

    def integers(self, key: str, count: int) -> list[int]:
        """Return a list of integers in [0, count), empty where it is absent."""
        return self.value(
            key,
            lambda found: (
                isinstance(found, list)
                and all(type(index) is int and 0 <= index < count for index in found)
            ),
            f"a list of integers below {count}",
            [],
        )

    def numbers(self, key: str, count: int, default: list[float] | None = None) -> list[float]:
        """Return `count` finite numbers."""
        found = self.value(
            key,
            lambda found: (
                isinstance(found, list)
                and len(found) == count
                and all(type(x) in (int, float) and abs(x) < MAX_NUMBER for x in found)
            ),
            f"{count} finite numbers",
            default,
        )
        return [float(number) for number in found]

    def texts(self, key: str, default: list[str] | None = None) -> list[str]:
        """Return a list of strings."""
        return self.value(
            key,
            lambda found: isinstance(found, list) and all(isinstance(text, str) for text in found),
            "a list of names",
            default,
        )

    def record(self, key: str, default: dict | None = None) -> "JsonRecord":
        """Return an object."""
        found = self.value(key, lambda found: isinstance(found, dict), "an object", default)
        return JsonRecord(self.path, key, found)

    def records(self, key: str, default: list | None = None) -> list["JsonRecord"]:
        """Return a list of objects."""
        found = self.value(
            key,
            lambda found: isinstance(found, list) and all(isinstance(x, dict) for x in found),
            "a list of objects",
            default,
        )
        return [JsonRecord(self.path, f"{key}[{i}]", values) for i, values in enumerate(found)]


def parse_record(path: Path, name: str, content: bytes) -> JsonRecord:
    """Read the JSON object that a part of a file holds."""
    try:
        values = json.loads(content)
    # Also numbers of too many digits and nesting that is too deep.
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path} has a {name} that is not JSON ({error}): it is damaged; copy it again."
        ) from error
    if not isinstance(values, dict):
        raise InputError(f"{path} has a {name} that is no JSON object: write it again.")
    return JsonRecord(path, name, values)
