"""Measure what skips cost and save, on synthetic test scenes and on photographs.

python docs/measure_skips.py    writes docs/results/skips.json and skips.png
"""

import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from matplotlib.figure import Figure

from asysplat.data.datamodule import collate, load
from asysplat.data.sources import FilesSource
from asysplat.evaluation.baselines import mean_color_images
from asysplat.evaluation.metrics import psnr
from asysplat.files import atomic_write
from asysplat.models.early_exit import EXACT, EarlyExit
from asysplat.models.network import Network
from asysplat.rendering import render
from asysplat.training.load import CONF
from asysplat.training.load import load as load_network

RESULTS = Path(__file__).parent / "results"
Batch = dict[str, Any]
Row = dict[str, Any]

WHERE_KNOWN = 0.1  # less confidence than in any scene measured here
SURE, KNOWN = EarlyExit(sure=WHERE_KNOWN), EarlyExit(known=WHERE_KNOWN)
SETTINGS = {
    "exact": EXACT,
    "sure": SURE,
    **{f"sure, coverage {share}": replace(SURE, coverage=share) for share in (0.9, 0.8, 0.6)},
    "known": KNOWN,
    **{f"faint {opacity}": EarlyExit(faint=opacity) for opacity in (0.02, 0.05, 0.1)},
}
MADE_UP = ((8, 64, 6), (8, 128, 3), (32, 64, 2), (8, 256, 1))  # views, side of an image, scenes
PHOTOGRAPHS = ("fern", "fox", "hololens-000", "mydesk")
SEEN = ((8, 128), (15, 128), (8, 256))  # views, side of an image
TARGETS = 4
ROUNDS = 3  # after one to warm up


def made_up(views: int, side: int, count: int) -> list[Batch]:
    """Return the first test scenes of conf/data/procedural.yaml."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        sizes = [f"data.{name}={side}" for name in ("height", "width")]
        config = compose("train", [*sizes, f"data.inputs={views}", f"data.test_scenes={count}"])
    data = instantiate(config.data)
    data.setup()
    return [collate([data.tests[data.name][index]]) for index in range(count)]


def photographs(folder: Path, views: int, side: int) -> list[Batch]:
    """Return a scene as tests/training/test_shipped.py takes it."""
    source = FilesSource(str(folder), side, side, window=(24, 96))
    return [collate([load(task) for task in source.evaluation("test", views, TARGETS)])]


def scenes(shared: Path) -> Iterator[tuple[str, list[Batch]]]:
    """Yield what is measured, by name; photographs that are absent are left out."""
    for views, side, count in MADE_UP:
        yield f"synthetic, {views} of {side}x{side}", made_up(views, side, count)
    for name in PHOTOGRAPHS:
        if (shared / "data" / name).is_dir():
            for views, side in SEEN:
                found = photographs(shared / "data" / name, views, side)
                yield f"{name}, {views} of {side}x{side}", found


@torch.no_grad()
def measure(net: Network, batches: list[Batch]) -> dict[str, Row]:
    """Predict and render all test views with every setting, in turns.

    Returns:
        For each setting: seconds of the process's CPUs, which other programs do not lengthen,
        median over the rounds of the sum over scenes; PSNR and the shares left out, means over
        scenes.
    """
    seconds: dict[str, list[float]] = {name: [] for name in SETTINGS}
    rows: dict[str, Row] = {}
    for number in range(ROUNDS + 1):
        for name, net.early_exit in SETTINGS.items():
            clock, qualities, skipped = 0.0, [], []
            for batch in batches:
                inputs, targets = batch["inputs"], batch["targets"]
                background = mean_color_images(inputs, targets)[..., 0, 0]
                clock -= time.process_time()
                image = render(net(inputs), targets.cameras, background, depth=False).image
                clock += time.process_time()
                qualities.append(psnr(image.clamp(0, 1), targets.images).mean().item())
                skipped.append(dict(net.skipped))
            if number > 0:
                seconds[name].append(clock)
            shares = {k: sum(each[k] for each in skipped) / len(batches) for k in skipped[0]}
            rows[name] = {"psnr": sum(qualities) / len(batches), "skipped": shares}
    exact = median(seconds["exact"])
    for name, row in rows.items():
        row["seconds"] = median(seconds[name])
        row["times_as_fast"] = exact / row["seconds"]
        row["gain"] = row["psnr"] - rows["exact"]["psnr"]
    return rows


def confidence(net: Network, batches: list[Batch]) -> list[float]:
    """Return the mean confidence of each scene's prior: what `sure` and `known` compare."""
    return [net.ask(batch["inputs"]).confidence.mean().item() for batch in batches]


def plot(results: dict[str, Any]) -> Figure:
    """Draw how much faster and how much better each setting is, a dot for each scene."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    families = ("sure", "faint")
    for axis, first in zip(axes, families, strict=True):
        for name in SETTINGS:
            if name != "exact" and (name.startswith("faint") == (first == "faint")):
                found = [scene["settings"][name] for scene in results["scenes"].values()]
                across = [row["times_as_fast"] for row in found]
                axis.scatter(across, [row["gain"] for row in found], s=18, label=name)
        axis.axhspan(-0.1, 0.0, color="0.9", zorder=0)
        axis.axvline(1, color="0.6", lw=0.8)
        axis.set_xlabel("times as fast as exact, photographs to all test views")
        axis.legend(frameon=False, fontsize=8)
    axes[0].set_ylabel("gain in PSNR (dB); gray: 0.1 dB lost")
    return figure


def main(shared: Path) -> None:
    """Measure all scenes, print a line for each setting, write both files."""
    torch.set_num_threads(1)
    net = load_network("shipped")
    results: dict[str, Any] = {
        "seconds": f"of the process's CPUs, one thread, median of {ROUNDS} rounds in turns",
        "settings": {name: asdict(skips) for name, skips in SETTINGS.items()},
        "scenes": {},
    }
    for name, batches in scenes(shared):
        rows = measure(net, batches)
        results["scenes"][name] = {"confidence": confidence(net, batches), "settings": rows}
        for setting, row in rows.items():
            print(f"{name}: {setting}: x{row['times_as_fast']:.2f}, {row['gain']:+.2f} dB")
    with atomic_write(RESULTS / "skips.json") as path:
        path.write_text(json.dumps(results, indent=2) + "\n")
    with atomic_write(RESULTS / "skips.png") as path:
        plot(results).savefig(path, dpi=120)


if __name__ == "__main__":
    beside = Path(__file__).resolve().parents[2] / "shared"
    main(Path(os.environ.get("ASYSPLAT_SHARED", beside)))
