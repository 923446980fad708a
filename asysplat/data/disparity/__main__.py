"""Estimate the disparities of photographs, which the depth term of the loss compares with.

python -m asysplat.data.disparity path/to/scenes

Maps that are there already are kept: a second call goes on where the first was stopped. Training
reads them from the same folder (data.disparities).
"""

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path

import torch
from numpy import ndarray
from rich.console import Console
from rich.progress import track
from torch.nn.functional import interpolate

from asysplat.data.bad_images import BadFrames
from asysplat.data.disparity.maps import BESIDE, map_folder, map_name, write_map
from asysplat.data.disparity.network import MODEL, load_depth_anything
from asysplat.data.images import load_photograph
from asysplat.data.readers import LAYOUTS, find_scenes
from asysplat.errors import InputError

CACHE = Path("~/.cache/asysplat/disparities")  # as in conf/data/disk.yaml
SIDE = 272  # most pixels of a map's shorter side: the loss compares every second of 544
Estimate = Callable[[ndarray], ndarray]  # [h, w, 3] of uint8 -> [H, W] of float32


def main(arguments: list[str] | None = None, estimate: Estimate | None = None) -> int:
    """Run the command with its arguments; `estimate` stands in for the network."""
    options = parse(arguments)
    try:
        layout, scenes = find_scenes(options.path, options.layout)
        _check_outside(options.folder, options.path)
        estimate = estimate or load_depth_anything(options.model, options.download)
        console = Console(stderr=True)
        for scene in scenes:
            folder = _folder(scene, options)
            made, kept = write_maps(layout, scene, folder, estimate, options.on_bad_image, console)
            print(f"{scene.name}: {made} maps written, {kept} were there: {folder}", flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def parse(arguments: list[str] | None) -> Namespace:
    parser = ArgumentParser(prog="python -m asysplat.data.disparity", description=__doc__)
    parser.add_argument("path", type=Path, help="a scene, or a folder of scenes")
    parser.add_argument("--layout", default="auto", choices=("auto", *LAYOUTS))
    parser.add_argument("--on-bad-frame", default="fail", choices=("fail", "skip"))
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--folder", type=Path, default=CACHE, help="where maps are kept")
    place.add_argument(
        "--beside", action="store_true", help=f"put them into each scene's own folder, {BESIDE}/"
    )
    parser.add_argument("--model", default=MODEL, help="a folder, or a name in Hugging Face's hub")
    parser.add_argument("--download", action="store_true", help="fetch weights that are missing")
    return parser.parse_args(arguments)


def write_maps(
    layout: str, scene: Path, folder: Path, estimate: Estimate, on_bad_image: str, console: Console
) -> tuple[int, int]:
    """Write the maps of one scene that are not there yet.

    Returns:
        How many were written, and how many were there.

    Raises:
        InputError: files that cannot be read or written; the maps written before stay.
    """
    bad = BadFrames(on_bad_image)
    posed = LAYOUTS[layout].read_scene(scene, bad)
    _make(folder)
    files = {folder / map_name(p.image, scene): p.image for p in posed.photographs}
    waiting = {file: image for file, image in files.items() if not file.exists()}
    written = 0
    for file, image in track(waiting.items(), posed.name, console=console, transient=True):
        pixels = None
        with bad.caught():
            pixels = load_photograph(image)
        if pixels is not None:
            write_map(file, shrunk(estimate(pixels), *pixels.shape[:2]))
            written += 1
    kept = len(files) - len(waiting)
    bad.settle(str(scene), kept + written)
    return written, kept


def shrunk(disparity: ndarray, height: int, width: int) -> ndarray:
    """Return the map of a photograph of height x width at its proportions, by area."""
    scale = min(1.0, SIDE / min(height, width))
    size = (round(scale * height), round(scale * width))
    return interpolate(torch.as_tensor(disparity)[None, None], size, mode="area")[0, 0].numpy()


def _folder(scene: Path, options: Namespace) -> Path:
    if not options.beside:
        return map_folder(scene, options.folder)
    if not scene.is_dir():
        raise InputError(f"{scene} is no folder: leave out --beside, and maps go to --folder.")
    return scene / BESIDE


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder} cannot be made ({error.strerror}): name another place with --folder."
        ) from error


def _check_outside(folder: Path, data: Path) -> None:
    data = (data if data.is_dir() else data.parent).resolve()
    if folder.expanduser().resolve().is_relative_to(data):
        raise InputError(
            f"{folder} lies in the data set {data}: name a folder elsewhere, or say --beside."
        )


if __name__ == "__main__":
    sys.exit(main())
