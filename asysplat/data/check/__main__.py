"""Show what a reader sees in a scene, on one screen and as a picture.

python -m asysplat.data.check path/to/scene

Ends with 0 where the cameras fit the images, with 1 where they do not, with 2 where the scene
cannot be read.
"""

import sys
import warnings
from argparse import ArgumentParser, Namespace
from itertools import chain, count
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from asysplat.data.bad_images import BadFrames, Policy
from asysplat.data.check.matches import PLACES
from asysplat.data.check.report import Report, check_scene
from asysplat.data.check.show import draw_report, print_report
from asysplat.data.readers import LAYOUTS, find_scenes
from asysplat.errors import InputError

FIRST_SCENES = 3  # so many are checked of a folder of more
RESOLUTION = 110  # pixels an inch of the picture


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    try:
        return check(options, Console())
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def parse(arguments: list[str] | None) -> Namespace:
    parser = ArgumentParser(prog="python -m asysplat.data.check", description=__doc__)
    parser.add_argument("path", type=Path, help="a scene, or a folder of scenes")
    parser.add_argument("--layout", default="auto", choices=("auto", *LAYOUTS))
    parser.add_argument(
        "--scene", help=f"the name of one of many; without it the first {FIRST_SCENES} are checked"
    )
    parser.add_argument("--on-bad-frame", default="fail", choices=("fail", "skip"))
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("check"),
        help="where SCENE/check.png is put, outside the data set; nothing is overwritten",
    )
    return parser.parse_args(arguments)


def check(options: Namespace, console: Console) -> int:
    """Check every chosen scene: 0 if the cameras of all fit, else 1."""
    layout, scenes = find_scenes(options.path, options.layout)
    _check_outside(options.out, options.path)
    chosen = _chosen(scenes, options.scene)
    if len(scenes) > 1:
        more = "" if len(chosen) == len(scenes) else "; --scene NAME checks another"
        console.print(f"checking {len(chosen)} of {len(scenes)} scenes{more}", highlight=False)
    all_fit = True
    for path in chosen:
        report = check_one(layout, path, options.on_bad_image, console)
        title = f"{report.sequence.name}, layout {layout}"
        picture = save_picture(report, title, options.out)
        print_report(report, title, console)
        console.print(f"picture: {picture}\n", soft_wrap=True, highlight=False)
        all_fit &= report.verdict.fits
    return 0 if all_fit else 1


def check_one(layout: str, path: Path, on_bad_image: Policy, console: Console) -> Report:
    """Make the report of one scene, under progress bars."""
    bad = BadFrames(on_bad_image)
    scene = LAYOUTS[layout].read_scene(path, bad)
    with Progress(console=console, transient=True) as progress, warnings.catch_warnings():
        # The report lists the frames that are left out.
        warnings.simplefilter("ignore")
        bars = {
            "decode": progress.add_task(f"{scene.name}: decoding", total=len(scene.photographs)),
            "match": progress.add_task(f"{scene.name}: matching", total=PLACES),
        }
        return check_scene(scene, bad, lambda bar: progress.advance(bars[bar]))


def save_picture(report: Report, title: str, out: Path) -> Path:
    """Save the report's picture under the first free name: check.png, check-2.png, ..."""
    folder = out / report.sequence.name.replace("/", "-")
    folder.mkdir(parents=True, exist_ok=True)
    names = chain(["check.png"], (f"check-{number}.png" for number in count(2)))
    file = next(folder / name for name in names if not (folder / name).exists())
    with file.open("xb") as handle:
        draw_report(report, title).savefig(handle, format="png", dpi=RESOLUTION)
    return file


def _chosen(scenes: list[Path], name: str | None) -> list[Path]:
    if name is None:
        return scenes[:FIRST_SCENES]
    named = [scene for scene in scenes if name in scene.parts]
    if not named:
        raise InputError(
            f"--scene {name} is none of the {len(scenes)} scenes: name one, such as "
            f"{scenes[0].name}."
        )
    return named


def _check_outside(out: Path, data: Path) -> None:
    data = (data if data.is_dir() else data.parent).resolve()
    if out.resolve().is_relative_to(data):
        raise InputError(
            f"{out.absolute()} lies in the data set {data}, where nothing is written: name a "
            "folder elsewhere with --out."
        )


if __name__ == "__main__":
    sys.exit(main())
