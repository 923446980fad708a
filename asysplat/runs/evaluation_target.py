"""Find what evaluate.py measures: a finished run, a checkpoint or another system's scenes."""

import glob
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import MISSING, DictConfig, OmegaConf, open_dict

from asysplat.errors import InputError
from asysplat.files import refuse_links
from asysplat.ranges import Count, Positive, check_options, check_training
from asysplat.runs import runs
from asysplat.runs.run_config import plain_options, read_config
from asysplat.runs.summary import TESTED

CHECKPOINT = "checkpoints/last.ckpt"
SYSTEMS = ("gaussians", "images", "refinement")  # options for scenes that no network predicts
DEVICE = "trainer.accelerator"  # not the run's, which may come from another machine
SOURCES = ("run", "init_path", *SYSTEMS)
# The others are train.py's.
OWN_OPTIONS = (
    *("run", *SYSTEMS, "refinement_seconds", "refinement_steps"),
    *("system", "post_optimization_steps", "write_gaussians", "write_images"),
)
# Their PLY files have positions divided by a quantile, and opacities that are no logits.
UNREADABLE = ("pixelsplat", "mvsplat")
SYSTEM = "evaluation/system"
# Options of the data that choose the images of a test, and their size.
IMAGES = ("inputs", "targets", "height", "width", "selection")
IMAGES += ("num_images", "test_scenes", "places")  # options of procedural scenes


@dataclass(frozen=True)
class EvaluationTarget:
    """What an evaluation measures."""

    config: DictConfig  # as train.py takes it; its init_path names the weights
    system: str | None  # the one of SYSTEMS that is given; None: a network
    folder: Path  # for the results
    fingerprint: dict[str, str | int]  # everything that the results depend on

    @property
    def scene_folder(self) -> Path:
        """The folder of the results of single scenes, another for every `fingerprint`."""
        return self.folder / "evaluation" / runs.hash_of(self.fingerprint)


def find_target(options: DictConfig, overrides: Sequence[str]) -> EvaluationTarget:
    """Find the target of evaluate.py from its options and the overrides of its command."""
    sources = [name for name in SOURCES if options.get(name) is not None]
    model = dict(override.partition("=")[::2] for override in overrides).get("model")
    if len(sources) > 1 or not (sources or model):
        raise InputError(
            f"{' and '.join(sources) or 'nothing'} is given to evaluate: give one of run=last, "
            "init_path=FILE, gaussians=FOLDER, images=FOLDER and refinement=3dgs, or model=NAME, "
            "as it is without training."
        )
    system = next(iter(set(sources) & set(SYSTEMS)), None)
    if system is None and options.system is not None:
        raise InputError(
            f"system={options.system} names the system that made gaussians=..., images=... or "
            "refinement=...: give both, or neither."
        )
    if options.write_gaussians is not None:
        _check_predicted(options, system)
    for name in ("write_gaussians", "write_images"):
        if options[name] is not None:
            _check_new(Path(options[name]), name)
    names_data = any(override.startswith("data") for override in overrides)
    if system in ("gaussians", "images") and not names_data:
        raise InputError(
            f"{system}={options[system]} is measured on photographs of the same scenes: add "
            "data=files data.root=my_scenes."
        )
    if options.run is not None:
        return _target_of_run(options, overrides)
    config = options.copy()
    with open_dict(config):
        for name in OWN_OPTIONS:
            config.pop(name, None)
    for key in OmegaConf.missing_keys(config):
        raise InputError(f"{key} is not set: add {key}=... to the command.")
    check_training(config)
    fingerprint = _describe(config, options)
    if system is None:
        stem = Path(str(options.init_path or model)).stem
    else:
        stem, made_of = _describe_source(system, options, overrides)
        fingerprint |= describe_system(config, options.system or stem, made_of)
    folder = Path(options.paths.logs) / "evaluate" / f"{stem}-{runs.hash_of(fingerprint)[:8]}"
    return EvaluationTarget(config, system, folder, fingerprint)


def _describe_source(
    system: str, options: DictConfig, overrides: Sequence[str]
) -> tuple[str, dict[str, Any]]:
    if system == "refinement":
        keys = ("refinement_seconds", "refinement_steps")
        key = keys[options.refinement_steps is not None]
        check_options({key: options[key]}, dict(zip(keys, (Positive, Count), strict=True)))
        (name,) = (
            value
            for key, _, value in (override.partition("=") for override in overrides)
            if key.lstrip("+") == system
        )
        return name, plain_options(options.refinement) | {key: options[key] for key in keys}
    path = Path(os.path.abspath(options[system]))
    name = path.stem if path.is_file() else path.name
    contents = contents_below(path)
    called = str(options.system or name)
    ply = any(file.endswith(".ply") for file in contents)
    if system == "gaussians" and ply and called.lower() in UNREADABLE:
        raise InputError(
            f"gaussians={options.gaussians} of {called}: the PLY files that it writes have scaled "
            "positions and opacities that are no logits, so that its scene is lost: give the "
            "images that it renders of the test views, images=FOLDER."
        )
    return name, contents


def _target_of_run(options: DictConfig, overrides: Sequence[str]) -> EvaluationTarget:
    """Take a run with its own options; the evaluation is written beside its results."""

    def find(logs: Path) -> list[Path]:
        return [run.folder for run in runs.find_runs(logs)]

    files = (runs.RESULTS, "config.yaml", CHECKPOINT)
    folder = runs.folder_of(options.run, Path(options.paths.logs), find, files)
    refuse_links(folder)
    checkpoint = folder / CHECKPOINT
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key not in (*OWN_OPTIONS, DEVICE) and not key.startswith("paths."):
            raise InputError(
                f"{key} does not go with run={options.run}, which is measured as it was tested: "
                f"leave it out, or give init_path={checkpoint} and the run's options instead."
            )
    config = read_config(folder / "config.yaml")
    config.init_path = str(checkpoint)
    config.trainer.accelerator = options.trainer.accelerator
    return EvaluationTarget(config, None, folder, _describe(config, options))


def _describe(config: DictConfig, options: DictConfig) -> dict[str, str | int]:
    described = runs.describe_run(config)
    described = {f"evaluation/{k.removeprefix('run/')}": v for k, v in described.items()}
    described["evaluation/post_optimization_steps"] = str(options.post_optimization_steps)
    return described


def _check_predicted(options: DictConfig, system: str | None) -> None:
    """Check that there are predictions to write."""
    if system is not None:
        raise InputError(
            f"write_gaussians={options.write_gaussians} writes what a model predicts, of run=..., "
            "init_path=... or model=...: give one of these, or leave it out."
        )


def _check_new(folder: Path, option: str) -> None:
    """Check that a folder to write to holds nothing yet."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{option}={folder} exists and is not an empty folder: name a new one, "
            "nothing is overwritten."
        )


def describe_system(config: DictConfig, system: str, made_of: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a system, whose scenes are `made_of` files or options, and what it is tested on."""
    tested = options_of_test(config, config.data.name)
    return {
        SYSTEM: system,
        "evaluation/made_of": runs.hash_of(made_of),
        **{f"{TESTED}{key}": value for key, value in tested.items()},
    }


def contents_below(path: Path) -> dict[str, Any]:
    """Return the content of a file, with its cameras, or of the files of a folder of scenes."""
    folder, stem = path, "*"
    if path.is_file():
        folder, stem = path.parent, glob.escape(path.stem)
    patterns = (f"{stem}.*", f"{stem}/*.*", f"{stem}/*/*/*")  # Gaussians, images, a COLMAP model
    files = [file for pattern in patterns for file in folder.glob(pattern) if file.is_file()]
    return {str(file.relative_to(folder)): runs.content_of(file) for file in files}


def options_of_test(config: DictConfig, test_set: str) -> dict[str, Any]:
    """Return the options of data and metrics that the numbers of a test set depend on."""
    data = plain_options(config.data)
    changes = (data["test_sets"] or {}).get(test_set) or {}
    if data.get("test_size"):
        data["height"], data["width"] = data["test_size"]
    data["root"] = data.get("test_root") or data.get("root")
    data |= changes
    options = {key: value for key, value in data.items() if key in IMAGES}
    options["data"] = test_set if "root" in changes else data["name"]
    options["root"] = runs.name_of(data["root"])
    options["index"] = runs.content_of(data.get("index"))
    metrics = plain_options(config.metrics)
    options |= {f"metrics.{key}": value for key, value in metrics.items() if key != "_target_"}
    return {key: value for key, value in options.items() if value not in (None, MISSING)}
