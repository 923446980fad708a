"""Check a scene: print its measurements on one screen, and draw them as a figure.

asysplat check path/to/scene

Exits with 0 if the cameras fit the images, with 1 if they do not, and with 2 if the scene cannot be
read.
"""

import sys
import warnings
from argparse import ArgumentParser, Namespace
from itertools import chain, count
from pathlib import Path

from asysplat.errors import InputError
from asysplat.files import check_exists

MAX_SCENES = 3  # checked of a folder of more
EXPECTED = "a scene, or a folder of scenes"


def read_arguments(words: list[str] | None = None) -> Namespace:
    """Read the command line; exit if there is no such path."""
    parser = ArgumentParser(prog="asysplat check", description=__doc__)
    parser.add_argument("path", type=Path, help=f"{EXPECTED}, of which {MAX_SCENES} are checked")
    parser.add_argument("--layout", default="auto", help="of its files; see data/README.md")
    parser.add_argument("--on-error", default="fail", choices=("fail", "skip"))
    help_of_out = "folder of SCENE/check.png, outside the data set; existing files are kept"
    parser.add_argument("--out", type=Path, default=Path("check"), help=help_of_out)
    arguments = parser.parse_args(words)
    try:
        check_exists(arguments.path, EXPECTED)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    return arguments


if __name__ == "__main__":  # now, since torch takes seconds
    given = read_arguments()

from rich.console import Console

from asysplat.data.bad_images import BadImages
from asysplat.data.check.report import Report, check_scene
from asysplat.data.check.show import draw_report, print_report
from asysplat.data.readers import find_scenes, read_scene
from asysplat.data.write import refuse_inside
from asysplat.interrupts import handle_signals
from asysplat.terminal import make_console


def main(arguments: Namespace) -> int:
    """Check scenes; return the exit status."""
    try:
        return check(arguments, make_console())
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def check(options: Namespace, console: Console) -> int:
    """Check up to MAX_SCENES scenes, and return 0 if the cameras of all fit, else 1."""
    layout, scenes = find_scenes(options.path, options.layout)
    refuse_inside(options.out, options.path, "name a folder elsewhere with --out")
    if len(scenes) > MAX_SCENES:
        more = f"checking {MAX_SCENES} of {len(scenes)} scenes; name one of them to check another"
        console.print(more, highlight=False)
    all_fit = True
    for path in scenes[:MAX_SCENES]:
        bad = BadImages(options.on_error)
        scene = read_scene(layout, path, bad)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the report lists the skipped images
            report = check_scene(scene, bad, console)
        title = f"{report.sequence.name}, layout {layout}"
        figure = save_figure(report, title, options.out)
        print_report(report, title, console)
        console.print(f"figure: {figure}\n", soft_wrap=True, highlight=False)
        all_fit &= report.verdict.fits
    return 0 if all_fit else 1


def save_figure(report: Report, title: str, out: Path) -> Path:
    """Save the report's figure under the first free name: check.png, check-2.png, ..."""
    folder = out / report.sequence.name.replace("/", "-")
    folder.mkdir(parents=True, exist_ok=True)
    names = chain(["check.png"], (f"check-{number}.png" for number in count(2)))
    file = next(folder / name for name in names if not (folder / name).exists())
    with file.open("xb") as handle:
        draw_report(report, title).savefig(handle, format="png", dpi=110)
    return file


if __name__ == "__main__":
    handle_signals()
    sys.exit(main(given))
