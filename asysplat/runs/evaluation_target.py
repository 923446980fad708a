"""Find what evaluate.py measures: a finished run, a checkpoint or files of Gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict

from asysplat.errors import InputError
from asysplat.files import refuse_links
from asysplat.runs.ranges import check_ranges
from asysplat.runs.run_config import read_config
from asysplat.runs.runs import RESULTS, describe_run, find_runs, folder_of, hash_of
from asysplat.runs.systems import describe_system

CHECKPOINT = "checkpoints/last.ckpt"
# The others are train.py's.
OWN_OPTIONS = ("run", "gaussians", "system", "post_optimization_steps", "write_gaussians")


@dataclass(frozen=True)
class EvaluationTarget:
    """What an evaluation measures."""

    config: DictConfig  # as train.py takes it; its init_path names the weights
    folder: Path  # for the results
    fingerprint: dict[str, str | int]  # everything that the results depend on

    @property
    def scene_folder(self) -> Path:
        """The folder of the results of single scenes, another for every `fingerprint`."""
        return self.folder / "evaluation" / hash_of(self.fingerprint)


def find_target(options: DictConfig, overrides: Sequence[str]) -> EvaluationTarget:
    """Find the target of evaluate.py from its options and the overrides of its command.

    Raises:
        InputError: none of run, init_path and gaussians is given, or several are; files do not
            exist; options that do not go together; a value that is missing or out of range.
    """
    sources = [name for name in ("run", "init_path", "gaussians") if options[name] is not None]
    if len(sources) != 1:
        raise InputError(
            f"{' and '.join(sources) or 'nothing'} is given to evaluate: give one of run=last, "
            "init_path=shipped and gaussians=FOLDER."
        )
    if options.gaussians is None and options.system is not None:
        raise InputError(
            f"system={options.system} names the system that made gaussians=...: give both, "
            "or neither."
        )
    if options.write_gaussians is not None:
        _check_new(Path(options.write_gaussians), options)
    names_data = any(override.startswith("data") for override in overrides)
    if options.gaussians is not None and not names_data:
        raise InputError(
            f"gaussians={options.gaussians} is measured on photographs of the same scenes: add "
            "data=files data.root=my_scenes."
        )
    if options.run is not None:
        return _target_of_run(options, overrides)
    config = options.copy()
    with open_dict(config):
        for name in OWN_OPTIONS:
            del config[name]
    for key in OmegaConf.missing_keys(config):
        raise InputError(f"{key} is not set: add {key}=... to the command.")
    check_ranges(config)
    fingerprint = _describe(config, options)
    stem = Path(options.gaussians or options.init_path).stem
    folder = Path(options.paths.logs) / "evaluate" / f"{stem}-{hash_of(fingerprint)[:8]}"
    return EvaluationTarget(config, folder, fingerprint)


def _target_of_run(options: DictConfig, overrides: Sequence[str]) -> EvaluationTarget:
    """Take a run with its own options; the evaluation is written beside its results."""

    def find(logs: Path) -> list[Path]:
        return [run.folder for run in find_runs(logs)]

    files = (RESULTS, "config.yaml", CHECKPOINT)
    folder = folder_of(options.run, Path(options.paths.logs), find, files)
    refuse_links(folder)
    checkpoint = folder / CHECKPOINT
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key not in OWN_OPTIONS and not key.startswith("paths."):
            raise InputError(
                f"{key} does not go with run={options.run}, which is measured as it was tested: "
                f"leave it out, or give init_path={checkpoint} and the run's options instead of "
                "run."
            )
    config = read_config(folder / "config.yaml")
    config.init_path = str(checkpoint)
    return EvaluationTarget(config, folder, _describe(config, options))


def _describe(config: DictConfig, options: DictConfig) -> dict[str, str | int]:
    """Describe what results depend on, under keys of the evaluation."""
    described = describe_run(config)
    described = {f"evaluation/{k.removeprefix('run/')}": v for k, v in described.items()}
    described["evaluation/post_optimization_steps"] = str(options.post_optimization_steps)
    if options.gaussians is not None:
        described |= describe_system(config, Path(options.gaussians), options.system)
    return described


def _check_new(folder: Path, options: DictConfig) -> None:
    """Check that there is something to write to `folder`, and nothing there yet."""
    if options.gaussians is not None:
        raise InputError(
            f"write_gaussians={folder} writes what a model predicts, and "
            f"gaussians={options.gaussians} are files: leave one out."
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"write_gaussians={folder} exists and is not an empty folder: name a new one, "
            "nothing is overwritten."
        )
