"""Finished runs on disk, and whether a configuration is among them."""

import hashlib
import json
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict

RESULTS = "metrics.json"
EVALUATION = "evaluation.json"  # what evaluate.py adds to a run
# Names, what watches a run, and what other keys have already taken their values from.
BESIDE_THE_POINT = ("name", "ckpt_path", "callbacks", "stage", "stages", "more_inputs")


@dataclass(frozen=True)
class Run:
    """A finished run.

    Args:
        folder: where it is.
        identity: of its configuration, see `identity`.
        seed: its own.
        results: the flat numbers and words of metrics.json and, where there is one,
            evaluation.json.
    """

    folder: Path
    identity: str
    seed: int
    results: dict[str, Any]


def identity(config: DictConfig) -> str:
    """A hash of all that the configuration resolves to, but for the seed and for what changes no
    number: places on disk, callbacks, loader workers. Runs of one identity and seed agree."""
    config = config.copy()
    with open_dict(config):
        config.paths = dict.fromkeys(config.paths, "")
        config.seed = config.data.workers = None
    resolved = OmegaConf.to_container(config, resolve=True)
    for key in BESIDE_THE_POINT:
        resolved.pop(key, None)
    return hashlib.sha256(json.dumps(resolved, sort_keys=True).encode()).hexdigest()[:16]


def describe_run(config: DictConfig) -> dict[str, str | int]:
    """What metrics.json says of the run itself: run/identity, run/seed, run/machine."""
    gpus = torch.cuda.device_count()
    machine = f"{gpus} x {torch.cuda.get_device_name()}" if gpus else f"{os.cpu_count()} CPU cores"
    return {
        "run/identity": identity(config),
        "run/seed": config.seed,
        "run/machine": f"{machine}, torch {torch.__version__}",
    }


def find_runs(logs: Path) -> Iterator[Run]:
    """Every finished run below `logs`, oldest first; a results file that cannot be read, which a
    run that was cut off may leave, is no result and is named in a warning."""
    found = sorted(logs.rglob(RESULTS), key=lambda path: (path.stat().st_mtime, path))
    for path in found:
        try:
            results = json.loads(path.read_text())
            run = Run(path.parent, results["run/identity"], results["run/seed"], results)
            extra = path.with_name(EVALUATION)
            if extra.exists():
                results.update(json.loads(extra.read_text()))
        except (ValueError, KeyError, TypeError):
            warnings.warn(
                f"{path} is not the results of a finished run: it is left out.", stacklevel=2
            )
            continue
        yield run


def find_run(logs: Path, config: DictConfig) -> Run | None:
    """The newest finished run of this configuration and seed."""
    wanted = identity(config), config.seed
    same = [run for run in find_runs(logs) if (run.identity, run.seed) == wanted]
    return same[-1] if same else None
