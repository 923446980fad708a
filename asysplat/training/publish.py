"""Publish the model of a run: its weights in half precision and a model card.

python -m asysplat.training.publish logs/asysplat/2026-01-31_12-00-00 checkpoints/my_model
"""

import csv
import json
import sys
from pathlib import Path

import torch
from omegaconf import OmegaConf

from asysplat.errors import InputError
from asysplat.files import atomic_write
from asysplat.training.checkpoints import save_weights
from asysplat.training.old_names import read_config, upgrade_results
from asysplat.training.runs import RESULTS
from asysplat.training.summary import METRICS, Results

LIMITS = "\n## Limits\n"
LARGEST = 16e6  # bytes


def publish(run: Path, target: Path) -> None:
    """Write `target`.safetensors and the card `target`.md with its origin and test results.

    The section "## Limits" of an existing card is kept, since it is written by hand.

    Args:
        run: the folder of a finished run.
        target: without a suffix.

    Raises:
        InputError: the run has not finished, or its weights are too large to ship.
    """
    try:
        results = upgrade_results(json.loads((run / RESULTS).read_text()))
        saved = torch.load(run / "checkpoints" / "last.ckpt", "cpu", weights_only=True)
    except OSError as error:
        raise InputError(
            f"{run} is no finished run: {error.filename} is missing; name a folder below logs/ "
            "that has metrics.json and checkpoints/last.ckpt."
        ) from error
    weights = saved["state_dict"]
    size = 2 * sum(tensor.numel() for tensor in weights.values())
    if size > LARGEST:
        raise InputError(
            f"{run} has weights of {size / 1e6:.1f} MB in half precision: at most "
            f"{LARGEST / 1e6:.0f} MB ship; train a narrower model."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    save_weights(weights, target.with_suffix(".safetensors"))
    card = target.with_suffix(".md")
    before = card.read_text() if card.exists() else ""
    limits = before[before.index(LIMITS) :] if LIMITS in before else ""
    text = _card(target.name, run, results, saved["global_step"], size) + limits
    with atomic_write(card) as partial:
        partial.write_text(text)


def _card(name: str, run: Path, results: Results, steps: int, size: int) -> str:
    """Write the card: command, data, time, test results and learning curve."""
    config = read_config(run / "config.yaml")
    overrides = OmegaConf.load(run / ".hydra" / "overrides.yaml")
    data = config.data.name
    hours = steps * results["cost/seconds_per_step"] / 3600
    rows = [
        f"| {label} | " + " | ".join(_number(results.get(f"{source}/{m}")) for m in METRICS) + " |"
        for label, source in (
            ("this model", f"test/{data}"),
            ("nearest input view, copied", f"baseline/{data}/nearest_view"),
            ("mean color of the inputs", f"baseline/{data}/mean_color"),
        )
    ]
    with open(run / "curve.csv", newline="") as file:
        curve = [dict(row) for row in csv.DictReader(file)]
    columns = [name for name in ("step", "minutes", "psnr", "lpips", "absrel") if name in curve[0]]
    every = max(1, len(curve) // 10)
    earlier = "".join(f"{name}, then " for name in config.get("earlier_stages") or ())
    return "\n".join(
        [
            f"# {name}",
            "",
            f"`python train.py {' '.join(overrides)}`, {earlier}{steps:,} steps of "
            f"{config.data.batch_size} scenes in {hours:.1f} hours on {results['run/machine']}, "
            f"seed {results['run/seed']}, revision {results['run/revision']}.",
            "",
            f"- **Network**: {results['cost/parameters'] / 1e6:.2f}M parameters, "
            f"{size / 1e6:.1f} MB in half precision.",
            f"- **Data**: {data}, {config.data.inputs} input, {config.data.targets} target views "
            f"of {config.data.height}x{config.data.width}.",
            f"- **Test**: scenes of {data} that were never trained on; {results['protocol/psnr']}.",
            "",
            "| | " + " | ".join(METRICS.values()) + " |",
            "|---" * (len(METRICS) + 1) + "|",
            *rows,
            "",
            "Learning curve, on validation scenes:",
            "",
            "| " + " | ".join(columns) + " |",
            "|---" * len(columns) + "|",
            *("| " + " | ".join(_number(row[c]) for c in columns) + " |" for row in curve[::every]),
            "",
        ]
    )


def _number(value: str | float | None) -> str:
    return "" if value in (None, "") else f"{float(value):.4g}"


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: python -m asysplat.training.publish RUN_FOLDER TARGET_WITHOUT_SUFFIX")
    try:
        publish(Path(sys.argv[1]), Path(sys.argv[2]))
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
