"""Estimate the disparities of images, for the depth term of the loss.

python -m asysplat.data.disparity path/to/scenes

Existing maps are kept: a second call continues after an interruption. Training reads the maps from
the same folder (data.disparities).
"""

import sys
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import torch
from numpy import ndarray
from rich.markup import escape
from rich.progress import track
from torch.nn.functional import interpolate

from asysplat.data.bad_images import BadImages
from asysplat.data.disparity import BESIDE, map_folder, map_name, write_map
from asysplat.data.disparity.network import MODEL, load_depth_anything
from asysplat.data.images import PANORAMA, load_image
from asysplat.data.readers import LAYOUTS, find_scenes, read_scene
from asysplat.data.write import refuse_inside
from asysplat.errors import InputError
from asysplat.interrupts import handle_signals
from asysplat.terminal import make_console

CACHE = Path("~/.cache/asysplat/disparities")  # as in conf/data/disk.yaml
MAX_SHORT_SIDE = 272  # pixels of a map: the loss compares every second pixel of 544
Estimate = Callable[[ndarray], ndarray]  # [h, w, 3] of uint8 -> [H, W] of float32


def main(arguments: list[str] | None = None, estimate: Estimate | None = None) -> int:
    """Run the command with its arguments; `estimate` replaces the network."""
    parser = ArgumentParser(prog="python -m asysplat.data.disparity", description=__doc__)
    parser.add_argument("path", type=Path, help="a scene, or a folder of scenes")
    parser.add_argument("--layout", default="auto", choices=("auto", *LAYOUTS))
    parser.add_argument("--on-error", default="fail", choices=("fail", "skip"))
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--folder", type=Path, default=CACHE, help="folder of the maps")
    help_of_beside = f"put maps into each scene's own folder, {BESIDE}/"
    place.add_argument("--beside", action="store_true", help=help_of_beside)
    help_of_model = "a folder, or a name on the Hugging Face Hub"
    parser.add_argument("--model", default=MODEL, help=help_of_model)
    parser.add_argument("--download", action="store_true", help="download missing weights")
    options = parser.parse_args(arguments)
    try:
        layout, scenes = find_scenes(options.path, options.layout)
        refuse_inside(options.folder, options.path, "name a folder elsewhere, or say --beside")
        estimate = estimate or load_depth_anything(options.model, options.download)
        for scene in scenes:
            folder = scene / BESIDE if options.beside else map_folder(scene, options.folder)
            if options.beside and not scene.is_dir():
                raise InputError(f"{scene} is not a folder: use --folder in place of --beside.")
            bad = BadImages(options.on_error)
            written, kept = write_maps(layout, scene, folder, estimate, bad)
            print(f"{scene.name}: {written} maps written, {kept} were there: {folder}", flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def write_maps(
    layout: str, scene: Path, folder: Path, estimate: Estimate, bad: BadImages
) -> tuple[int, int]:
    """Write the missing maps of one scene; return the numbers of written and of existing maps."""
    posed = read_scene(layout, scene, bad)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder} cannot be created ({error.strerror}): name another folder with --folder."
        ) from error
    # Networks of perspective images are not made for panoramas.
    images = [image.file for image in posed.images if image.lens.model != PANORAMA]
    missing = [image for image in images if not (folder / map_name(image, scene)).exists()]
    written, kept = 0, len(images) - len(missing)
    console = make_console(stderr=True)
    for image in track(missing, escape(posed.name), console=console, transient=True):
        for pixels in bad.read_each(load_image, [(image,)]):
            disparity = shrink(estimate(pixels), *pixels.shape[:2])
            write_map(folder / map_name(image, scene), disparity)
            written += 1
    bad.report(str(scene), kept + written)
    return written, kept


def shrink(disparity: ndarray, height: int, width: int) -> ndarray:
    """Resample the map of an image of height x width to the image's proportions, by area."""
    scale = min(1.0, MAX_SHORT_SIDE / min(height, width))
    size = (round(scale * height), round(scale * width))
    return interpolate(torch.as_tensor(disparity)[None, None], size, mode="area")[0, 0].numpy()


if __name__ == "__main__":
    handle_signals()
    sys.exit(main())
