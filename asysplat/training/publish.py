"""Publish the model of a run: its weights in half precision and a model card.

python -m asysplat.training.publish logs/asysplat/2026-01-31_12-00-00 checkpoints/my_model
"""

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
from asysplat.training.summary import BASELINES, METRICS

LIMITS = "\n## Limits\n"
LARGEST = 16e6  # bytes


def publish(run: Path, target: Path) -> None:
    """Write `target`.safetensors and the card `target`.md: command, network, data, test results.

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
    weights, steps = saved["state_dict"], saved["global_step"]
    size = 2 * sum(tensor.numel() for tensor in weights.values())
    if size > LARGEST:
        raise InputError(
            f"{run} has weights of {size / 1e6:.1f} MB in half precision: at most "
            f"{LARGEST / 1e6:.0f} MB ship; train a narrower model."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    save_weights(weights, target.with_suffix(".safetensors"))

    config = read_config(run / "config.yaml")
    data = config.data
    command = " ".join(["python train.py", *OmegaConf.load(run / ".hydra" / "overrides.yaml")])
    earlier = "".join(f"{name}, then " for name in config.get("earlier_stages") or ())
    hours = steps * results["cost/seconds_per_step"] / 3600
    rows = [("", *METRICS.values()), ["---"] * (len(METRICS) + 1)]
    for label, source in {"this model": "test/{}", **BASELINES}.items():
        values = (results.get(f"{source.format(data.name)}/{metric}") for metric in METRICS)
        rows.append((label, *("" if value is None else f"{value:.4g}" for value in values)))
    card = target.with_suffix(".md")
    before = card.read_text() if card.exists() else ""
    text = f"""# {target.name}

`{command}`, {earlier}{steps:,} steps of {data.batch_size} scenes in {hours:.1f} hours on \
{results["run/machine"]}, seed {results["run/seed"]}, revision {results["run/revision"]}.

- **Network**: {results["cost/parameters"] / 1e6:.2f}M parameters, {size / 1e6:.1f} MB.
- **Data**: {data.name}, {data.inputs} input, {data.targets} target views of \
{data.height}x{data.width}.
- **Test**: scenes of {data.name} that were never trained on; {results["protocol/psnr"]}.

"""
    text += "".join(f"| {' | '.join(row)} |\n" for row in rows)
    if LIMITS in before:
        text += before[before.index(LIMITS) :]
    with atomic_write(card) as partial:
        partial.write_text(text)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m asysplat.training.publish RUN_FOLDER TARGET_WITHOUT_SUFFIX")
    try:
        publish(Path(sys.argv[1]), Path(sys.argv[2]))
    except InputError as error:
        sys.exit(f"error: {error}")
