"""Photographs on disk: seconds to open a scene, and frames a second beside training."""

import json
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from omegaconf import DictConfig
from PIL import Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat.benchmark.compare import RATE, Watched
from asysplat.benchmark.model import Workload, make_net, make_views
from asysplat.benchmark.options import CPU, find_device
from asysplat.benchmark.plot import bars
from asysplat.benchmark.table import machine_note, make_table, number, spread, text
from asysplat.benchmark.timing import Measurement, Result, seconds_of, summary, time_in_rounds
from asysplat.data import ImageCache, ProceduralScene, SceneOptions, files_data, open_scene
from asysplat.data.readers.common import opencv_from_opengl

NO_CACHE, FILLING, FILLED = CACHES = ("none", "filled meanwhile", "filled")
MODEL = "asysplat_4m4s"
WATCHED = Watched(names=("cache",), alike=(), kinds={"frames_per_second": RATE}, rows="loading")
RENDERED = (135, 240)  # height, width of the procedural views; enlarged to the photographs' size
RENDERED_VIEWS = 8
QUALITY = 90  # of the JPEG


def write_photographs(folder: Path, frames: int, height: int, width: int) -> Path:
    """Write a transforms.json and `frames` JPEG files of different bytes; return the folder."""
    scene = ProceduralScene(seed=0, height=RENDERED[0], width=RENDERED[1], num_images=frames)
    views = scene.views([number * frames // RENDERED_VIEWS for number in range(RENDERED_VIEWS)])
    images = [_enlarge(image.permute(1, 2, 0).numpy(), height, width) for image in views.images]
    (folder / "images").mkdir(parents=True)
    entries = []
    # The change of axes from OpenGL to OpenCV is its own inverse.
    poses = [opencv_from_opengl(pose) for pose in scene.cameras.cam_to_world.double().numpy()]
    for frame in track(range(frames), "photographs", transient=True):
        name = f"images/{frame:05d}.jpg"
        # The comment gives each file bytes of its own, by which the cache identifies it.
        comment = f"photograph {frame}"
        images[frame % RENDERED_VIEWS].save(folder / name, quality=QUALITY, comment=comment)
        entries.append({"file_path": name, "transform_matrix": poses[frame].tolist()})
    focal = float(scene.cameras.intrinsics[0, 0, 0]) * width / RENDERED[1]
    content = {"w": width, "h": height, "fl_x": focal, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def _enlarge(image: np.ndarray, height: int, width: int) -> Image.Image:
    """Enlarge an image, and add grain as photographs have it: flat areas decode faster."""
    levels = Image.fromarray((image * 255).astype(np.uint8)).resize((width, height))
    grain = np.random.default_rng(0).normal(0, 4, (height, width, 1))
    return Image.fromarray((np.asarray(levels) + grain).clip(0, 255).astype(np.uint8))


def measure(options: DictConfig, console: Console) -> Result:
    """Open a scene and load training tasks from it, `options.repeats` times.

    Returns:
        "scene": frames, the photographs' and the views' sizes; "open": seconds to open the scene;
        "loading": frames a second for each state of the cache on disk; "network": frames a second
        that training would take, without rendering. All with median and interquartile range.

    Raises:
        InputError: a scene that cannot be read; an unknown override or device.
    """
    device, config = find_device(options.device), options.data
    net, size = make_net(MODEL, config.overrides, device)
    height, width = size["height"], size["width"]
    workload = Workload(MODEL, net, "fp32", make_views(size["inputs"], height, width, device))
    frames = size["inputs"] + config.targets  # of a training task
    with TemporaryDirectory() as folder:
        procedural = Path(folder) / "scene"
        root = config.root or write_photographs(procedural, config.frames, *config.photographs)
        open_views = partial(open_scene, root, SceneOptions(height, width))
        sequence = open_views()
        lens = sequence.scene.images[0].lens
        count = max(1, sequence.num_images // frames)
        make_data = partial(
            files_data,
            **size,
            root=str(root),
            window=[frames, 128],
            name="benchmark",
            targets=config.targets,
            batch_size=1,
            num_workers=config.num_workers,
            seed=0,
            steps_per_epoch=1,
        )

        def loading(cache: ImageCache | None) -> float:
            data = make_data(cache=cache)
            return seconds_of(lambda: list(data.tasks(0, count)), CPU) / (count * frames)

        def seconds() -> dict[str, float]:
            with TemporaryDirectory(dir=folder) as fresh:
                return {
                    "open": seconds_of(open_views, CPU),
                    NO_CACHE: loading(None),
                    FILLING: loading(ImageCache(fresh)),
                    FILLED: loading(ImageCache(fresh)),
                    "network": seconds_of(workload.step, device) / frames,
                }

        timed = Measurement(seconds)
        with console.status(f"{options.repeats} rounds"):
            time_in_rounds([timed], options.repeats)
    rates = {name: summary([1 / s for s in timed.seconds[name]]) for name in (*CACHES, "network")}
    return {
        "scene": {
            "frames": sequence.num_images,
            "photographs": [lens.height, lens.width],
            "views": [height, width],
            "workers": config.num_workers,
        },
        "open": timed.summary("open"),
        "network": rates["network"],
        "loading": [
            {
                "cache": name,
                "frames_per_second": rates[name],
                "over_network": rates[name]["median"] / rates["network"]["median"],
            }
            for name in CACHES
        ],
    }


def tables(results: Result) -> list[Table]:
    """Show the seconds to open a scene, and the frames a second of each state of the cache."""
    scene, opened = results["scene"], results["open"]
    each = opened["median"] / scene["frames"]
    columns = {
        "frames": text("{frames}"),
        "ms, no pixel read": spread("open"),
        "ms / frame": number("each", "{:.2f}", unit=1e-3),
    }
    loading_columns = {
        "cache on disk": text("{cache}"),
        "frames / s": spread("frames_per_second", "{:.0f}", unit=1.0),
        "loading\n/ network": number("over_network", "{:.1f}"),
    }
    photographs, views = ("x".join(map(str, scene[name])) for name in ("photographs", "views"))
    network = spread("network", "{:.0f}", unit=1.0)(results)
    notes = (
        f"{machine_note(results)}\n"
        f"photographs of {photographs} for views of {views}, by {scene['workers']} workers\n"
        f"the network alone takes {network} frames / s in training"
    )
    return [
        make_table("Opening a scene", columns, [scene | {"open": opened, "each": each}]),
        make_table("Loading training tasks", loading_columns, results["loading"], notes),
    ]


def plot(results: Result) -> Figure:
    """Plot the frames a second of each state of the cache, and those that the network takes."""
    names = [row["cache"] for row in results["loading"]]
    rates = [row["frames_per_second"] for row in results["loading"]]
    parts = {"loading, by the cache on disk": [rate["median"] for rate in rates]}
    network = ("the network takes", [results["network"]["median"]] * len(rates))
    return bars(names, parts, network, "frames a second", spread=[rate["iqr"] for rate in rates])
