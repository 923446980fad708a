"""Photographs on disk: how soon a scene opens, and whether loading keeps ahead of training."""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from asysplat.benchmark.compare import RATE, Watched
from asysplat.benchmark.data.photographs import write_photographs
from asysplat.benchmark.model.workload import Workload, make_net, make_views
from asysplat.benchmark.options import find_device
from asysplat.benchmark.plot import bars
from asysplat.benchmark.table import make_table, measured_on, number, spread, text
from asysplat.benchmark.timing import Measurement, Result, seconds_of, summary, time_in_rounds
from asysplat.data import ImageCache, files_data, open_scene

CPU = torch.device("cpu")  # which reads
NO_CACHE, FIRST, LATER = CACHES = ("none", "filled meanwhile", "filled")
MODEL = "asysplat_4m4s"
WATCHED = Watched(names=("cache",), alike=(), kinds={"frames_per_second": RATE}, rows="loading")


def measure(options: DictConfig, console: Console) -> Result:
    """Open a scene and draw training tasks from it, `options.repeats` times.

    Returns:
        "scene": frames, the photographs' and the views' sizes; "open": seconds until a scene has
        been opened; "loading": frames a second for each state of the cache on disk; "network":
        frames a second that training would take, without rendering. All with median and
        interquartile range.

    Raises:
        InputError: a scene that cannot be read; an unknown override or device.
    """
    device, wanted = find_device(options.device), options.data
    net, size = make_net(MODEL, wanted.overrides, device)
    height, width = size["height"], size["width"]
    workload = Workload(MODEL, net, "fp32", make_views(size["inputs"], height, width, device))
    frames = size["inputs"] + wanted.targets  # of a training task
    with TemporaryDirectory() as folder:
        made = Path(folder) / "scene"
        root = wanted.root or write_photographs(made, wanted.frames, *wanted.photographs)
        open_views = partial(open_scene, root, height, width)
        sequence = open_views()
        lens = sequence.scene.photographs[0].lens
        count = max(1, sequence.num_frames // frames)
        make_data = partial(
            files_data,
            **size,
            root=str(root),
            window=[frames, 128],
            name="benchmark",
            targets=wanted.targets,
            batch_size=1,
            num_workers=wanted.num_workers,
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
                    FIRST: loading(ImageCache(fresh)),
                    LATER: loading(ImageCache(fresh)),
                    "network": seconds_of(workload.step, device) / frames,
                }

        scene = Measurement(seconds)
        with console.status(f"{options.repeats} rounds"):
            time_in_rounds([scene], options.repeats)
    rates = {name: summary([1 / s for s in scene.seconds[name]]) for name in (*CACHES, "network")}
    return {
        "scene": {
            "frames": sequence.num_frames,
            "photographs": [lens.height, lens.width],
            "views": [height, width],
            "workers": wanted.num_workers,
        },
        "open": scene.summary("open"),
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
    """Show how soon a scene opens, and how fast its frames come."""
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
        f"{measured_on(results)}\n"
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
