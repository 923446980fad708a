"""Prepare scenes for training: one file a scene and size, with photographs as they will be used.

asysplat prepare DL3DV-ALL-960P prepared --sizes 256,512,544x960
python train.py data=dl3dv data.root=prepared ...

Scenes are folders, or zip files of one scene each. Finished ones are kept: the same command goes on
after an interruption. Exits with 1 if scenes are bad; out/bad_scenes.txt names them.
"""

import os
import re
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from asysplat.errors import InputError
from asysplat.files import check_exists, make_folder


def read_arguments(words: list[str] | None = None) -> Namespace:
    """Read the command line; exit if its path, part or sizes cannot be."""
    parser = ArgumentParser(prog="asysplat prepare", description=__doc__)
    parser.add_argument("root", type=Path, help="a scene, or a folder of scenes")
    parser.add_argument("out", type=Path, help="folder of OUT/256x256/SCENE.safetensors")
    help_of_sizes = "sides of squares, or heights x widths: 256,512,544x960"
    parser.add_argument("--sizes", required=True, help=help_of_sizes)
    parser.add_argument("--part", default="1/1", help="3/64: every 64th scene, from the third on")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="number of processes")
    parser.add_argument("--lossless", action="store_true", help="WebP in place of JPEG")
    help_of_disparities = "estimate them, too, with a network: a folder, or a name on the Hub"
    parser.add_argument("--disparities", nargs="?", const="", help=help_of_disparities)
    parser.add_argument("--download", action="store_true", help="download its missing weights")
    methods = ("lanczos", "bicubic", "bilinear")
    parser.add_argument("--resampling", default=methods[0], choices=methods, help="as in training")
    parser.add_argument("--layout", default="auto", help="of its files; see data/README.md")
    help_of_on_error = "skip: a scene goes without images that cannot be used"
    parser.add_argument(
        "--on-error", default="fail", choices=("fail", "skip"), help=help_of_on_error
    )
    parser.add_argument("--verify", action="store_true", help="write damaged files again")
    arguments = parser.parse_args(words)
    try:
        check_exists(arguments.root, "a scene, or a folder of scenes")
        arguments.part, arguments.sizes = read_part(arguments.part), read_sizes(arguments.sizes)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    return arguments


def read_part(text: str) -> tuple[int, int]:
    """Return a part's number, from 1 on, and the number of parts."""
    match = re.fullmatch(r"([0-9]+)/([0-9]+)", text)
    part, parts = map(int, match.groups()) if match else (0, 0)
    if not 1 <= part <= parts:
        raise InputError(f"--part is {text}: expected K/N with K from 1 to N, such as 3/64.")
    return part, parts


def read_sizes(text: str) -> list[tuple[int, int]]:
    """Return heights and widths."""
    sizes = []
    for size in text.split(","):
        match = re.fullmatch(r"([1-9][0-9]*)(?:x([1-9][0-9]*))?", size)
        if match is None:
            raise InputError(f"--sizes has {size!r}: expected sizes such as 256,512,544x960.")
        height, width = match.groups()
        sizes.append((int(height), int(width or height)))
    return sizes


if __name__ == "__main__":  # now, since torch takes seconds
    given = read_arguments()

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context

import torch
from rich.progress import track

from asysplat.data.prepare.disparity import MODEL, load_depth_anything
from asysplat.data.prepare.scene_files import (
    Encoding,
    Preparation,
    find_sources,
    is_whole,
    prepare_scene,
)
from asysplat.data.write import refuse_inside
from asysplat.interrupts import handle_signals
from asysplat.terminal import make_console


def main(arguments: Namespace) -> int:
    """Prepare the scenes that the command line names; return the exit status."""
    try:
        return run(arguments)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(options: Namespace) -> int:
    """Prepare the scenes of a part, and print and list what became of them."""
    (part, parts), disparities = options.part, options.disparities
    if disparities is not None:
        disparities = disparities or MODEL
        load_depth_anything(disparities, options.download)
    layout, sources = find_sources(options.root, options.layout)
    refuse_inside(options.out, options.root, "name a folder outside of it")
    make_folder(options.out, "OUT")
    preparation = Preparation(
        options.out,
        options.sizes,
        Encoding(options.resampling, options.lossless, disparities),
        layout,
        options.on_error,
    )
    names = Counter(preparation.file(source, (1, 1)).stem for source in sources)
    name, count = names.most_common(1)[0]
    if count > 1:
        raise InputError(f"{options.root} holds {count} scenes called {name}: rename all but one.")
    chosen = sources[part - 1 :: parts]
    if options.verify:
        drop_damaged([preparation.file(s, size) for s in chosen for size in preparation.sizes])
    todo = [source for source in chosen if preparation.missing(source)]
    written, bad = 0, []
    for source, result in prepare_all(todo, preparation, options.workers):
        written += isinstance(result, int)
        if isinstance(result, str):
            bad.append(f"{source}: {result}")
    kept = len(chosen) - len(todo)
    print(f"{options.out}: {written} scenes written, {kept} were there, {len(bad)} are bad")
    listed = options.out / ("bad_scenes.txt" if parts == 1 else f"bad_scenes_{part}_of_{parts}.txt")
    listed.unlink(missing_ok=True)
    if bad:
        listed.write_text("\n".join([*sorted(bad), ""]))
        print(f"bad scenes: {listed}")
    return 1 if bad else 0


def drop_damaged(files: Sequence[Path]) -> None:
    """Delete the files that do not hold what was written."""
    bar = track(files, "verifying", console=make_console(stderr=True), transient=True)
    for file in [file for file in bar if file.is_file() and not is_whole(file)]:
        print(f"{file} is damaged: it is written again", file=sys.stderr)
        file.unlink()


def prepare_all(
    scenes: Sequence[Path], preparation: Preparation, workers: int
) -> Iterator[tuple[Path, int | str]]:
    """Yield each scene, when it is done, and the result of `prepare_scene`."""
    console, prepare = make_console(stderr=True), partial(prepare_scene, preparation=preparation)
    bar = partial(track, description="scenes", total=len(scenes), console=console, transient=True)
    workers = min(workers, len(scenes))
    if workers <= 1:
        yield from bar((scene, prepare(scene)) for scene in scenes)
        return
    # Spawned, since a fork would share torch's threads, each process with one of its own.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), torch.set_num_threads, (1,))
    with pool:
        futures = {pool.submit(prepare, scene): scene for scene in scenes}
        try:
            for future in bar(as_completed(futures)):
                yield futures[future], future.result()
        finally:
            pool.shutdown(cancel_futures=True)


if __name__ == "__main__":
    handle_signals()
    sys.exit(main(given))
