"""Measure what the settings of scale=laptop cost and give, a training with each.

python docs/measure_training.py    writes docs/results/training.json and training.png

What has ended, in logs/training_<its name>, is not run again. Seconds are those of short runs, one
after the other, when all trainings are done: let nothing else run then.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from asysplat.benchmark.machine import describe_machine
from asysplat.files import atomic_write
from asysplat.report.front import draw_front

REPO = Path(__file__).resolve().parents[1]
RESULTS = REPO / "docs" / "results"
STEPS = 120  # of two scenes, half as many as scale=laptop has
TIMED = 12  # steps

# Names, and what differs from scale=laptop.
SETTINGS = {
    "120 steps": [],
    "30 steps": ["steps=30"],
    "60 steps": ["steps=60"],
    "240 steps": ["steps=240"],
    "half the width": ["width=0.125"],
    "twice the width": ["width=0.5"],
    "learning rate 3e-3": ["learning_rate=3e-3"],
    "learning rate 3e-4": ["learning_rate=3e-4"],
    "fine patch 8": ["model.patch_fine=8"],
    "1 scene a step": ["stages.stage1.batch_size=1", f"steps={2 * STEPS}"],
    "2 targets": ["data.targets=2", "+data.test_sets.same.targets=4"],
    "8 targets": ["data.targets=8", "+data.test_sets.same.targets=4"],
    "no SSIM": ["training.loss.ssim=0"],
    "seed 1": ["seed=1"],
}
METRICS = {
    "psnr": ("PSNR (dB)", "higher", (23.7, 24.2)),
    "lpips": ("LPIPS", "lower", (0.1, 0.11)),
}


def run(name: str, overrides: list[str]) -> dict[str, Any]:
    """Train, unless that was done; return what the run measured."""
    runs = REPO / "logs" / f"training_{name.replace(' ', '_')}"
    if not list(runs.glob("*/metrics.json")):
        chosen = {"steps": str(STEPS), "name": runs.name, "~callbacks.figures": ""}
        chosen |= dict(override.split("=", 1) for override in overrides)
        # Validated once, at the end.
        chosen["validate_every"] = chosen["steps"]
        options = [f"{key}={value}" if value else key for key, value in chosen.items()]
        subprocess.run([sys.executable, "train.py", *options], cwd=REPO, check=True)
    (path,) = runs.glob("*/metrics.json")
    return json.loads(path.read_text())


def measure(name: str, overrides: list[str]) -> dict[str, Any]:
    """Return what a setting costs, and the metrics of its test."""
    numbers = run(name, overrides)
    short = run(f"timed {name}", [*overrides, f"steps={TIMED}"])
    steps = int(dict(override.split("=", 1) for override in overrides).get("steps", STEPS))
    # Other targets are for training: the test is of the same views for all.
    test = "test/same" if "test/same/psnr" in numbers else "test/procedural"
    return {
        "name": name,
        "overrides": overrides,
        "seconds": steps * short["cost/seconds_per_step"],
        "peak_gb": numbers["cost/peak_gb"],
        "parameters": numbers["cost/parameters"],
        **{
            metric: numbers[f"{test}/{metric}"]
            for metric in ("psnr", "ssim", "lpips", "absrel", "delta1")
        },
    }


def plot(rows: list[dict[str, Any]]) -> Figure:
    """Draw seconds of training against quality, the front first."""
    figure = Figure(figsize=(14, 6), layout="constrained")
    for axes, (metric, how) in zip(figure.subplots(1, 2), METRICS.items(), strict=True):
        label, better, (low, high) = how
        points = [(row["name"], row["seconds"], row[metric]) for row in rows]
        inside = [point for point in points if low <= point[2] <= high]
        outside = [f"{name}: {value:.4g}" for name, _, value in points if not low <= value <= high]
        axes.set(xlabel="seconds of training", ylabel=f"{label}, {better} is better", xscale="log")
        draw_front(axes, inside, better, "tab:blue")
        if outside:
            axes.set_title(f"not shown: {'; '.join(outside)}")
    return figure


def main() -> None:
    for name, overrides in SETTINGS.items():
        run(name, overrides)
    rows = [measure(name, overrides) for name, overrides in SETTINGS.items()]
    machine = describe_machine() | {"threads": torch.get_num_threads()}
    with atomic_write(RESULTS / "training.json") as path:
        path.write_text(json.dumps({"machine": machine, "rows": rows}, indent=2) + "\n")
    with atomic_write(RESULTS / "training.png") as path:
        plot(rows).savefig(path, dpi=100)


if __name__ == "__main__":
    main()
