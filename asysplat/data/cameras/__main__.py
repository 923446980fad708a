"""Find the cameras of photographs or of a video: structure from motion.

asysplat cameras my_photographs
"""

import sys
from argparse import ArgumentParser
from pathlib import Path

from asysplat.data.cameras.find import find_cameras
from asysplat.data.write import refuse_inside
from asysplat.errors import InputError
from asysplat.interrupts import handle_signals
from asysplat.terminal import make_console


def main(arguments: list[str] | None = None) -> int:
    parser = ArgumentParser(prog="asysplat cameras", description=__doc__)
    parser.add_argument("path", type=Path, help="a folder of photographs, or a video")
    help_of_out = "folder of the cameras, outside of that of the photographs"
    parser.add_argument("--out", type=Path, default=Path("logs/cameras"), help=help_of_out)
    parser.add_argument("--frames", type=int, default=100, help="greatest number, of a video")
    parser.add_argument("--on-error", default="fail", choices=("fail", "skip"))
    options = parser.parse_args(arguments)
    try:
        refuse_inside(options.out, options.path, "name a folder elsewhere with --out")
        chosen = (options.path, options.out, options.frames, options.on_error)
        print(find_cameras(*chosen, make_console()))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    handle_signals()
    sys.exit(main())
