"""Loading of photographs from disk: seconds to open a scene, and frames loaded per second."""

import json
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from omegaconf import DictConfig
from PIL import Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat.data import ImageCache, ProceduralScene, SceneOptions, files_data, open_scene
from asysplat.data.readers.common import opencv_from_opengl
from benchmarks.compare import RATE, TrackedMetrics
from benchmarks.options import CPU
from benchmarks.table import machine_note, make_table, median_iqr_column, text_column
from benchmarks.timing import Measurement, Result, measure_run, summarize, time_in_rounds

NO_CACHE, FILLED = CACHES = ("none", "filled")
TRACKED = TrackedMetrics(
    names=("cache",), must_match=(), kinds={"frames_per_second": RATE}, rows="loading"
)
RENDERED = (135, 240)  # height and width of the procedural views, before they are enlarged
RENDERED_VIEWS = 8


def write_photographs(folder: Path, frames: int, height: int, width: int) -> Path:
    """Write a transforms.json and `frames` JPEG files, no two of equal bytes; return the folder."""
    scene = ProceduralScene(seed=0, height=RENDERED[0], width=RENDERED[1], num_images=frames)
    views = scene.views([number * frames // RENDERED_VIEWS for number in range(RENDERED_VIEWS)])
    # With grain, as photographs have it: flat areas decode faster.
    grain = np.random.default_rng(0).normal(0, 4, (height, width, 1))
    images = []
    for view in views.images:
        levels = Image.fromarray((view.permute(1, 2, 0).numpy() * 255).astype(np.uint8))
        enlarged = np.asarray(levels.resize((width, height)))
        images.append(Image.fromarray((enlarged + grain).clip(0, 255).astype(np.uint8)))
    (folder / "images").mkdir(parents=True)
    entries = []
    # The change of axes from OpenGL to OpenCV is its own inverse.
    poses = [opencv_from_opengl(pose) for pose in scene.cameras.cam_to_world.double().numpy()]
    for frame in track(range(frames), "photographs", transient=True):
        name = f"images/{frame:05d}.jpg"
        # The comment gives each file bytes of its own, by which the cache identifies it.
        comment = f"photograph {frame}"
        images[frame % RENDERED_VIEWS].save(folder / name, quality=90, comment=comment)
        entries.append({"file_path": name, "transform_matrix": poses[frame].tolist()})
    focal = float(scene.cameras.intrinsics[0, 0, 0]) * width / RENDERED[1]
    content = {"w": width, "h": height, "fl_x": focal, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def measure(options: DictConfig, console: Console) -> Result:
    """Open a scene and load training tasks from it, `options.repeats` times.

    Returns:
        "scene": number of frames, sizes of photographs and views; "open": seconds to open the
        scene; "loading": frames per second, without a cache on disk and with a filled one.
    """
    config = options.data
    height, width = config.views
    frames = config.inputs + config.targets  # images of a training task
    count = max(1, config.frames // frames)
    with TemporaryDirectory() as folder:
        root = write_photographs(Path(folder) / "scene", config.frames, *config.photographs)

        def time_loading(cache: ImageCache | None) -> float:
            data = files_data(
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
                cache=cache,
            )
            return measure_run(lambda: list(data.tasks(0, count)), CPU) / (count * frames)

        def time_once() -> dict[str, float]:
            with TemporaryDirectory(dir=folder) as fresh:
                open_views = partial(open_scene, root, SceneOptions(height, width))
                times = {"open": measure_run(open_views, CPU), NO_CACHE: time_loading(None)}
                time_loading(ImageCache(fresh))  # fills it
                times[FILLED] = time_loading(ImageCache(fresh))
                return times

        timed = Measurement(time_once)
        time_in_rounds([timed], options.repeats, console)
    rates = {name: summarize([1 / s for s in timed.seconds[name]]) for name in CACHES}
    loading = [{"cache": name, "frames_per_second": rate} for name, rate in rates.items()]
    scene = {"frames": config.frames, "photographs": list(config.photographs)}
    scene |= {"views": [height, width], "workers": config.num_workers}
    return {"scene": scene, "open": timed.summarize("open"), "loading": loading}


def tables(results: Result) -> list[Table]:
    """Show the frames per second without and with a cache, and the seconds to open a scene."""
    scene = results["scene"]
    columns = {
        "cache on disk": text_column("{cache}"),
        "frames / s": median_iqr_column("frames_per_second", "{:.0f}", unit=1.0),
    }
    photographs, views = ("x".join(map(str, scene[name])) for name in ("photographs", "views"))
    notes = (
        f"{machine_note(results)}\n"
        f"photographs of {photographs} for views of {views}, by {scene['workers']} workers\n"
        f"opening a scene of {scene['frames']}: {median_iqr_column('open')(results)} ms, "
        "no pixel read"
    )
    return [make_table("Loading training tasks", columns, results["loading"], notes)]
