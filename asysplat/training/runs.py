"""Finished runs on disk, and whether a configuration is among them."""

import hashlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import torch
from omegaconf import MISSING, DictConfig, OmegaConf, open_dict

from asysplat.data.build import tested_sets
from asysplat.training.revision import revision

RESULTS = "metrics.json"
EVALUATION = "evaluation.json"  # what evaluate.py adds to a run
# Names, places on disk, what watches a run, and what other keys have already taken their values
# from.
BESIDE_THE_POINT = (
    *("name", "ckpt_path", "rerun", "paths", "callbacks"),
    *("stage", "stages", "selections", "more_inputs", "replica_size"),
    *("data.root", "data.index", "data.cache", "data.test_sets"),
    *(f"training.loss.perceptual_term.{name}" for name in ("weights", "download")),
)


@dataclass(frozen=True)
class Run:
    """A finished run.

    Args:
        folder: where it is.
        identity: of its configuration, see `identity`.
        seed: its own.
        revision: of the code that made it, see `revision`.
        results: the flat numbers and words of metrics.json and, where there is one,
            evaluation.json.
    """

    folder: Path
    identity: str
    seed: int
    revision: str
    results: dict[str, Any]

    def agrees(self, data: Mapping[str, str]) -> bool:
        """Whether it read what `data` names, as far as both know; `data` as `data_of` has it."""
        return all(self.results.get(key, value) == value for key, value in data.items())

    def covers(self, data: Mapping[str, str]) -> bool:
        """Whether it read all of `data`; it may have been tested on more."""
        return all(self.results.get(key) == value for key, value in data.items())


def identity(config: DictConfig) -> str:
    """A hash of all that the configuration resolves to, but for

    - the seed, and what changes no number: callbacks, loader workers, the cache;
    - places on disk: of a test root and of a checkpoint to start from it counts only whether there
      is one, and `data_of` says which;
    - further test sets, which change no number of the others; `data_of` has them too.

    Runs of one identity, seed and data agree. A value that is not given (`???`) is no obstacle.
    """
    config = config.copy()
    with open_dict(config):
        config.paths = dict.fromkeys(config.paths, "")
        config.seed = config.data.num_workers = config.data.test_sets = None
    resolved = OmegaConf.to_container(config, resolve=True)
    resolved["init_path"] = resolved["init_path"] is not None
    resolved["data"]["test_root"] = resolved["data"].get("test_root") is not None
    for key in BESIDE_THE_POINT:
        *groups, name = key.split(".")
        reduce(getitem, groups, resolved).pop(name, None)
    return _hash(resolved)


def data_of(config: DictConfig) -> dict[str, str]:
    """What a run of the configuration reads, wherever it lies, as metrics.json has it.

    run/data/root and run/data/test_root are the names of those folders; run/data/index and
    run/init_path hashes of what these files hold; run/test_sets/<name> a hash of the options of a
    further test set, its own root and index likewise. What is not given is left out.
    """
    data = OmegaConf.to_container(config.data, resolve=True)
    places = {
        "run/data/root": _name(data.get("root")),
        "run/data/test_root": _name(data.get("test_root")),
        "run/data/index": _content(data.get("index")),
        "run/init_path": _content(config.init_path),
    }
    tested = tested_sets(data["test_sets"], data["name"], on_disk="root" in data)
    for name, options in tested.items():
        how = dict(options or {})
        how |= {"root": _name(how.get("root")), "index": _content(how.get("index"))}
        places[f"run/test_sets/{name}"] = _hash(how)
    return {key: value for key, value in places.items() if value is not None}


def _name(path: str | None) -> str | None:
    """Of a folder; None for what is not given."""
    return None if path in (None, MISSING) else Path(os.path.abspath(path)).name


def _content(path: str | None) -> str | None:
    """A hash of the file; the name of what cannot be read as one."""
    if path in (None, MISSING):
        return None
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]
    except OSError:
        return _name(path)


def _hash(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def describe_run(config: DictConfig) -> dict[str, str | int]:
    """What metrics.json says of the run itself: run/identity, run/seed, run/revision (see
    `revision`), run/machine, and what `data_of` says."""
    gpus = torch.cuda.device_count()
    machine = f"{gpus} x {torch.cuda.get_device_name()}" if gpus else f"{os.cpu_count()} CPU cores"
    return {
        "run/identity": identity(config),
        "run/seed": config.seed,
        "run/revision": revision(),
        "run/machine": f"{machine}, torch {torch.__version__}",
        **data_of(config),
    }


def find_runs(logs: Path) -> Iterator[Run]:
    """Every finished run below `logs`, oldest first; a results file that cannot be read, which a
    run that was cut off may leave, is no result and is named in a warning."""
    found = sorted(logs.rglob(RESULTS), key=lambda path: (path.stat().st_mtime, path))
    for path in found:
        try:
            results = json.loads(path.read_text())
            keys = ("run/identity", "run/seed", "run/revision")
            run = Run(path.parent, *(results[key] for key in keys), results)
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
    """The newest finished run of this configuration, seed and data; one of this revision of the
    code comes before those of others."""
    wanted, data = (identity(config), config.seed), data_of(config)
    same = [run for run in find_runs(logs) if (run.identity, run.seed) == wanted]
    same = [run for run in same if run.covers(data)]
    return max(reversed(same), key=lambda run: run.revision == revision(), default=None)
