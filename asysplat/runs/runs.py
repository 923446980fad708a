"""Find finished runs on disk, and the one that a configuration describes."""

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from operator import getitem
from pathlib import Path
from typing import Any

import torch
from omegaconf import MISSING, DictConfig, open_dict

from asysplat.data.sources import tested_sets
from asysplat.errors import InputError
from asysplat.files import read_json
from asysplat.runs.machine import revision
from asysplat.runs.run_config import flat_options, plain_options, read_config
from asysplat.runs.stages import stage_configs

RESULTS = "metrics.json"
PICTURE = "contact.png"  # in the folder of a reconstruction
SCENE = "scene.safetensors"  # there, too; run= goes on from it
RECONSTRUCTION = ("start.png", PICTURE, SCENE)  # a folder with one of them is a reconstruction's
EVALUATION = "evaluation.json"  # added to a run by evaluate.py
# The options that tell a run from others, at first sight.
CHOICES = (
    *("geometry_ratio", "seed", "learning_rate", "model.layers", "steps"),
    *("name", "width", "state_size", "metrics.name"),
    *(f"data.{key}" for key in ("name", "inputs", "height", "width", "batch_size")),
    *(f"training.loss.{key}" for key in ("ssim", "perceptual", "depth", "opacity")),
)
# Names, paths, callbacks, keys that are only interpolated into others, and keys that only split the
# batch.
NOT_HASHED = (
    *("name", "ckpt_path", "rerun", "paths", "callbacks", "logger"),
    *("stage", "stages", "earlier_stages", "selections", "windows"),
    *("more_inputs", "replica_size", "farthest"),
    *("allow_missing_losses", "training.loss.allow_missing"),
    *("data.root", "data.index", "data.test_sets"),
    *(f"trainer.{name}" for name in ("devices", "num_nodes", "strategy")),
    *("trainer.num_sanity_val_steps", "data.micro_batch", "data.prefetch"),
    *("training.checkpoint_layers", "training.compile", "training.views_at_once"),
    *(f"training.loss.perceptual_term.{name}" for name in ("backbone_dir", "download")),
)


@dataclass(frozen=True)
class Run:
    """A finished run."""

    folder: Path
    config_hash: str  # see the function `config_hash`
    seed: int
    revision: str  # revision of the code that made it
    results: dict[str, Any]  # content of metrics.json and, if there is one, evaluation.json

    def is_consistent_with(self, data: Mapping[str, str]) -> bool:
        """Return whether no entry of `data` (see `data_of`) differs from the run's."""
        return all(self.results.get(key, value) == value for key, value in data.items())

    def covers(self, data: Mapping[str, str]) -> bool:
        """Return whether the run read all of `data` (see `data_of`), and perhaps more test sets."""
        return all(self.results.get(key) == value for key, value in data.items())


def config_hash(config: DictConfig, earlier: Sequence[DictConfig] | None = None) -> str:
    """Hash the `hashed_options`: runs of one hash, seed and `data_of` have the same numbers."""
    return hash_of(hashed_options(config, earlier))


def hashed_options(
    config: DictConfig, earlier: Sequence[DictConfig] | None = None
) -> dict[str, Any]:
    """Return the resolved options of a run that change its numbers, other than its seed.

    Of the test root and a checkpoint to start from, only whether they are given is returned.
    Missing values (`???`) are allowed.
    """
    earlier = stage_configs(config)[:-1] if earlier is None else earlier
    config = config.copy()
    with open_dict(config):
        if config.data.get("seed") == config.seed:
            config.data.seed = None
        config.paths = dict.fromkeys(config.paths, "")
        config.seed = config.data.num_workers = config.data.test_sets = None
    resolved = plain_options(config)
    resolved["init_path"] = resolved["init_path"] is not None
    resolved["data"]["test_root"] = resolved["data"].get("test_root") is not None
    for key in NOT_HASHED:
        *groups, name = key.split(".")
        reduce(getitem, groups, resolved).pop(name, None)
    stages = enumerate(earlier)
    resolved["stages"] = [config_hash(stage, earlier[:index]) for index, stage in stages]
    return resolved


def data_of(config: DictConfig) -> dict[str, str]:
    """Describe the data that a run reads: names of folders, and hashes of files' contents."""
    data = plain_options(config.data)
    described = {
        "run/data/root": name_of(data.get("root")),
        "run/data/test_root": name_of(data.get("test_root")),
        "run/data/index": content_of(data.get("index")),
        "run/init_path": content_of(config.init_path),
    }
    test_sets = tested_sets(data["test_sets"], data["name"], on_disk="root" in data)
    for name, options in test_sets.items():
        options = dict(options or {})
        options |= {"root": name_of(options.get("root")), "index": content_of(options.get("index"))}
        described[f"run/test_sets/{name}"] = hash_of(options)
    return {key: value for key, value in described.items() if value is not None}


def name_of(path: str | Path | None) -> str | None:
    """Return the last name of a path; None if it is not given."""
    return None if path in (None, MISSING) else Path(os.path.abspath(path)).name


def content_of(path: str | Path | None) -> str | None:
    """Hash a file's content; return the path's name if it cannot be read as a file."""
    if path in (None, MISSING):
        return None
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]
    except OSError:
        return name_of(path)


def hash_of(values: object) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def describe_run(config: DictConfig) -> dict[str, str | int]:
    """Describe a run for metrics.json: hash, seed, revision, machine and `data_of`."""
    gpus = torch.cuda.device_count()
    machine = f"{gpus} x {torch.cuda.get_device_name()}" if gpus else f"{os.cpu_count()} CPU cores"
    return {
        "run/config_hash": config_hash(config),
        "run/seed": config.seed,
        "run/revision": revision(),
        "run/machine": f"{machine}, torch {torch.__version__}",
        **data_of(config),
    }


def find_runs(logs: Path) -> Iterator[Run]:
    """Yield every finished run below `logs`, oldest first; warn of results that are damaged."""
    for path in files_below(logs, RESULTS):
        if any((path.parent / name).exists() for name in RECONSTRUCTION):
            continue
        try:
            results = read_json(path)
            described = (results[f"run/{key}"] for key in ("config_hash", "seed", "revision"))
            run = Run(path.parent, *described, results)
            extra = path.with_name(EVALUATION)
            if extra.exists():
                results.update(read_json(extra))
        except (ValueError, KeyError, TypeError):
            what = "is not the results of a finished run: it is left out."
            warnings.warn(f"{path} {what}", stacklevel=2)
        else:
            yield run


def find_reconstructions(logs: Path) -> list[Path]:
    """Return the finished reconstructions below `logs` that left a scene, oldest first."""
    folders = (path.parent for path in files_below(logs, RESULTS))
    return [folder for folder in folders if (folder / SCENE).exists()]


def files_below(folder: Path, name: str) -> list[Path]:
    """Return the files of a name below a folder, oldest first."""
    return sorted(folder.rglob(name), key=lambda path: (path.stat().st_mtime, path))


def folder_of(
    run: object, logs: Path, find: Callable[[Path], list[Path]], files: Sequence[str]
) -> Path:
    """Return the folder of a finished run, which must have these files.

    "last" is the last of those that `find` returns below `logs`.
    """
    folder = Path(str(run))
    if run == "last":
        folders = find(logs)
        if not folders:
            raise InputError(
                f"run=last found no finished run in {logs}: name its folder, or set paths.logs=."
            )
        folder = folders[-1]
    if missing := [file for file in files if not (folder / file).is_file()]:
        raise InputError(
            f"run={run} has no {missing[0]}: name the folder of a finished run, or last."
        )
    return folder


def differences(run: Run, config: DictConfig) -> dict[str, tuple[Any, Any]]:
    """Return the options whose values differ between a run and a configuration: (run, config)."""
    before = _options_of(run.folder)
    current = flat_options(hashed_options(config, ()))
    keys = sorted(before.keys() & current.keys(), key=lambda key: (key.count("."), key))
    return {key: (before[key], current[key]) for key in keys if before[key] != current[key]}


@cache
def _options_of(folder: Path) -> dict[str, Any]:
    try:
        return flat_options(hashed_options(read_config(folder / "config.yaml"), ()))
    except (OSError, ValueError, KeyError, AttributeError):
        return {}


def find_run(logs: Path, config: DictConfig) -> Run | None:
    """Find the newest finished run of this configuration, seed and data, of this revision first."""
    key, data = (config_hash(config), config.seed), data_of(config)
    runs = (run for run in find_runs(logs) if (run.config_hash, run.seed) == key)
    same = [run for run in runs if run.covers(data)]
    return max(reversed(same), key=lambda run: run.revision == revision(), default=None)
