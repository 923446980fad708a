"""Loading of training tasks: from photographs, and from the prepared files of the same scenes."""

import io
import json
import os
import tarfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

import numpy as np
from omegaconf import DictConfig
from PIL import Image
from rich.console import Console
from rich.table import Table

from asysplat.data import ProceduralScene, files_data
from asysplat.data.prepare.__main__ import prepare_all
from asysplat.data.prepare.scene_files import Encoding, Preparation, find_sources
from asysplat.data.readers.common import opencv_from_opengl
from asysplat.data.readers.prepared import read_file
from benchmarks.compare import RATE, TIME, TrackedMetrics
from benchmarks.options import CPU
from benchmarks.table import machine_note, make_table, median_iqr_column, number_column, text_column
from benchmarks.timing import Measurement, Result, measure_run, summarize, time_in_rounds

SOURCES = ("photographs", "prepared")
TRACKED = TrackedMetrics(
    names=("source",),
    must_match=(),
    kinds={"views_per_second": RATE, "start": TIME},
    rows="loading",
)
RENDERED = (135, 240)  # height and width of the procedural views, before they are enlarged
RENDERED_VIEWS = 8
DRAWN = 8  # images of a scene that a container is asked for
READINGS = 20  # of a container, each of other images


def write_scenes(root: Path, scenes: int, frames: int, height: int, width: int) -> None:
    """Write scenes in the layout of DL3DV: PNG of video frames, the files of all being the same."""
    scene = ProceduralScene(seed=0, height=RENDERED[0], width=RENDERED[1], num_images=frames)
    # With grain, as photographs have it: flat areas decode faster.
    grain = np.random.default_rng(0).normal(0, 2, (height, width, 1))
    frame = root / "frame.png"
    views = scene.views([number * frames // RENDERED_VIEWS for number in range(RENDERED_VIEWS)])
    for number, image in enumerate(views.images):
        levels = Image.fromarray((image.permute(1, 2, 0).numpy() * 255).astype(np.uint8))
        enlarged = np.asarray(levels.resize((width, height)))
        pixels = (enlarged + grain).clip(0, 255).astype(np.uint8)
        Image.fromarray(pixels).save(frame.with_stem(f"frame{number}"))
    focal = float(scene.cameras.intrinsics[0, 0, 0]) * width / RENDERED[1]
    # The change of axes from OpenGL to OpenCV is its own inverse.
    poses = [opencv_from_opengl(pose) for pose in scene.cameras.cam_to_world.double().numpy()]
    entries = [
        {"file_path": f"images/{number:05d}.png", "transform_matrix": pose.tolist()}
        for number, pose in enumerate(poses)
    ]
    content = json.dumps({"w": width, "h": height, "fl_x": focal, "frames": entries})
    for number in range(scenes):
        folder = root / "1K" / f"{number:064x}"
        (folder / "images_4").mkdir(parents=True)
        (folder / "transforms.json").write_text(content)
        for index in range(frames):
            source = frame.with_stem(f"frame{index % RENDERED_VIEWS}")
            os.link(source, folder / "images_4" / f"{index:05d}.png")


def measure(options: DictConfig, console: Console) -> Result:
    """Prepare scenes once, and load training tasks from them and from their photographs.

    Returns:
        "scenes": their number and sizes; "prepare": seconds; "loading": for each of SOURCES,
        seconds to list and open the scenes, and views per second, in `options.repeats` rounds;
        "containers": see `measure_containers`.
    """
    config = options.data
    (height, width), frames = config.views, config.inputs + config.targets
    with TemporaryDirectory() as folder:
        roots = dict(zip(SOURCES, (Path(folder, source) for source in SOURCES), strict=True))
        roots["photographs"].mkdir()
        write_scenes(roots["photographs"], config.scenes, config.frames, *config.photographs)
        layout, scenes = find_sources(roots["photographs"], "auto")
        preparation = Preparation(roots["prepared"], [(height, width)], Encoding(), layout)
        workers = max(1, config.num_workers)
        seconds = measure_run(lambda: list(prepare_all(scenes, preparation, workers)), CPU)

        def time_loading(root: Path) -> dict[str, float]:
            data = partial(
                files_data,
                root=str(root),
                height=height,
                width=width,
                inputs=config.inputs,
                window=[frames, 128],
                name="benchmark",
                targets=config.targets,
                batch_size=1,
                num_workers=config.num_workers,
                seed=0,
                steps_per_epoch=1,
            )
            start = measure_run(lambda: data().setup(), CPU)
            loading = measure_run(lambda: list(data().tasks(0, config.tasks)), CPU)
            return {"start": start, "view": loading / (config.tasks * frames)}

        timed = [
            Measurement(partial(time_loading, root), {"source": s}) for s, root in roots.items()
        ]
        time_in_rounds(timed, options.repeats, console)
        containers = measure_containers(preparation.file(scenes[0], (height, width)), folder)
    loading = [
        m.row
        | {"start": m.summarize("start")}
        | {"views_per_second": summarize([1 / s for s in m.seconds["view"]])}
        for m in timed
    ]
    sizes = {"photographs": list(config.photographs), "views": [height, width]}
    numbers = {"scenes": config.scenes, "frames": config.frames, "workers": config.num_workers}
    return {
        "scenes": numbers | sizes,
        "prepare": seconds,
        "loading": loading,
        "containers": containers,
    }


def measure_containers(file: Path, folder: str) -> list[Result]:
    """Read DRAWN random images of a scene: milliseconds, and bytes from disk for each byte."""
    images = [image.file.read() for image in read_file(file).images]
    names = [f"{index:05d}.jpg" for index in range(len(images))]
    tar, archive = Path(folder, "scene.tar"), Path(folder, "scene.zip")
    with tarfile.open(tar, "w") as packed, ZipFile(archive, "w") as zipped:
        for name, image in zip(names, images, strict=True):
            entry = tarfile.TarInfo(name)
            entry.size = len(image)
            packed.addfile(entry, io.BytesIO(image))
            zipped.writestr(name, image)

    def from_tar(indices: Sequence[int]) -> list[bytes]:
        with tarfile.open(tar, "r:") as packed:
            members = (packed.extractfile(names[index]) for index in indices)
            return [member.read() for member in members if member]

    def from_zip(indices: Sequence[int]) -> list[bytes]:
        with ZipFile(archive) as zipped:
            return [zipped.read(names[index]) for index in indices]

    def from_prepared(indices: Sequence[int]) -> list[bytes]:
        opened = read_file(file).images
        return [opened[index].file.read() for index in indices]

    paths = {"tar": (tar, from_tar), "zip": (archive, from_zip), "prepared": (file, from_prepared)}
    return [{"container": name} | time_reading(*path, images) for name, path in paths.items()]


def time_reading(
    file: Path, read: Callable[[Sequence[int]], list[bytes]], images: Sequence[bytes]
) -> Result:
    """Read at random, first from disk and then from the system's memory."""
    rng, needed, from_disk, seconds = np.random.default_rng(0), 0, 0, []
    for _ in range(READINGS):
        indices = rng.choice(len(images), DRAWN, replace=False).tolist()
        os.sync()
        with file.open("rb") as handle:
            os.posix_fadvise(handle.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        before = bytes_from_disk()
        assert read(indices) == [images[index] for index in indices]
        from_disk += bytes_from_disk() - before
        needed += sum(len(images[index]) for index in indices)
        seconds.append(measure_run(partial(read, indices), CPU))
    return {"seconds": summarize(seconds), "bytes": from_disk / needed}


def bytes_from_disk() -> int:
    """Return the bytes that this process has had read from disk."""
    counters = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(counters["read_bytes"])


def tables(results: Result) -> list[Table]:
    """Show views per second and seconds to start, and the containers."""
    scenes = results["scenes"]
    loading = {
        "from": text_column("{source}"),
        "views / s": median_iqr_column("views_per_second", "{:.0f}", unit=1.0),
        "start, s": median_iqr_column("start", "{:.2f}", unit=1.0),
    }
    photographs, views = ("x".join(map(str, scenes[name])) for name in ("photographs", "views"))
    count = scenes["scenes"] * scenes["frames"]
    notes = (
        f"{machine_note(results)}\n"
        f"{scenes['scenes']} scenes of {scenes['frames']} photographs of {photographs}, for views "
        f"of {views}, by {scenes['workers']} workers\n"
        f"prepared by as many, {count / results['prepare']:.0f} photographs / s; start: scenes are "
        "listed, and the first tasks loaded"
    )
    containers = {
        "container": text_column("{container}"),
        "ms": median_iqr_column("seconds", "{:.2f}"),
        "bytes from disk": number_column("bytes", "{:.2f}"),
    }
    title = f"{DRAWN} random images of {scenes['frames']}"
    disk_notes = "ms: in the system's memory; bytes: from disk, for each byte of the images"
    return [
        make_table("Loading training tasks", loading, results["loading"], notes),
        make_table(title, containers, results["containers"], disk_notes),
    ]
