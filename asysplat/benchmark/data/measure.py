"""The whole measurement, as plain numbers."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console

from asysplat.benchmark.choices import check_repeats, find_device
from asysplat.benchmark.data.photographs import write_photographs
from asysplat.benchmark.model.task import Task, make_net, make_views
from asysplat.benchmark.timing import Timer, rounds, run_timer, seconds_of, summary
from asysplat.data import ImageCache, SceneDataModule, files_data, open_scene

CPU = torch.device("cpu")  # which reads
NO_CACHE, FIRST, LATER = "none", "filled meanwhile", "filled"
MODEL = "asysplat_4m4s"

Result = dict[str, Any]


def measure(options: DictConfig, console: Console) -> Result:
    """Open a scene and draw training tasks from it, `options.repeats` times.

    Returns:
        "scene": frames, the photographs' and the views' sizes; "open": seconds until a scene has
        been opened; "loading": frames a second for each state of the cache on disk; "network":
        frames a second that training would take, without rendering. All with median and
        interquartile range.

    Raises:
        InputError: repeats below 1; a scene that cannot be read; an unknown word or device.
    """
    check_repeats(options.repeats)
    device, wanted = find_device(options.device), options.data
    net, size = make_net(MODEL, wanted.words, device)
    views = make_views(size["views"], size["height"], size["width"], device)
    task = Task(MODEL, net, "fp32", torch.float32, views)
    with _scene(wanted) as root, TemporaryDirectory() as folder:
        capture = open_scene(root, size["height"], size["width"])
        lens = capture.scene.photographs[0].lens
        drawn = size["views"] + wanted.targets  # frames of a task
        count = max(1, capture.num_frames // drawn)

        def loading(cache: ImageCache | None) -> float:
            data = _data(str(root), size, wanted, cache)
            return seconds_of(lambda: list(data.tasks(0, count)), CPU) / (count * drawn)

        def both_passes() -> dict[str, float]:
            with TemporaryDirectory(dir=folder) as fresh:
                return {name: loading(ImageCache(fresh)) for name in (FIRST, LATER)}

        timers: list[Timer] = [
            run_timer("open", lambda: open_scene(root, size["height"], size["width"]), CPU),
            lambda: {NO_CACHE: loading(None)},
            both_passes,
            lambda: {"network": seconds_of(task.step, device) / drawn},
        ]
        with console.status(f"{options.repeats} rounds"):
            seconds = rounds(timers, options.repeats)
    rates = {name: summary([1 / s for s in seconds[name]]) for name in seconds if name != "open"}
    network = rates.pop("network")
    return {
        "scene": {
            "frames": capture.num_frames,
            "photographs": [lens.height, lens.width],
            "views": [size["height"], size["width"]],
            "workers": wanted.workers,
        },
        "open": summary(seconds["open"]),
        "network": network,
        "loading": [
            {
                "cache": name,
                "frames_per_second": rate,
                "over_network": rate["median"] / network["median"],
            }
            for name, rate in rates.items()
        ],
    }


@contextmanager
def _scene(wanted: DictConfig) -> Iterator[Path]:
    """The user's, or one that is made up and taken away again."""
    if wanted.root is not None:
        yield Path(wanted.root)
        return
    with TemporaryDirectory() as folder:
        write_photographs(Path(folder) / "scene", wanted.frames, *wanted.photographs)
        yield Path(folder) / "scene"


def _data(
    root: str, size: dict[str, int], wanted: DictConfig, cache: ImageCache | None
) -> SceneDataModule:
    return files_data(
        root=root,
        height=size["height"],
        width=size["width"],
        window=[size["views"] + wanted.targets, 128],
        cache=cache,
        name="benchmark",
        inputs=size["views"],
        targets=wanted.targets,
        batch_size=1,
        num_workers=wanted.workers,
        seed=0,
        steps_per_epoch=1,
    )
