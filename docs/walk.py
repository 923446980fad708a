"""Print the files of asysplat that views or Gaussians enter, in their order, as a script runs.

python docs/walk.py reconstruct my_scene
python docs/walk.py train steps=1
"""

import runpy
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

REPO = Path(__file__).resolve().parents[1]
PACKAGE = f"{REPO / 'asysplat'}/"
VALUES = ("Photographs", "Views", "Gaussians")


def walk(script: Path, arguments: list[str]) -> dict[str, tuple[str, str]]:
    """Run a script; return the first function of each file that is passed one of VALUES.

    A value counts if it is an argument itself, as a function's `self` does too.

    Returns:
        The function's name and the value's type, by file relative to the package.
    """
    entered: dict[str, tuple[str, str]] = {}

    def observe(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        file = code.co_filename
        if event != "call" or not file.startswith(PACKAGE) or file in entered:
            return
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        types = [type(frame.f_locals.get(name)).__name__ for name in names]
        if value := next((name for name in types if name in VALUES), None):
            entered[file] = code.co_qualname, value

    sys.argv = [str(script), *arguments]
    sys.path.insert(0, str(REPO))
    threading.setprofile(observe)
    sys.setprofile(observe)
    try:
        runpy.run_path(str(script), run_name="__main__")
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return {file.removeprefix(PACKAGE): first for file, first in entered.items()}


if __name__ == "__main__":
    entered = walk(REPO / f"{sys.argv[1]}.py", sys.argv[2:])
    for number, (file, (function, value)) in enumerate(entered.items(), 1):
        print(f"{number:2} {file:42} {function}: {value}")
