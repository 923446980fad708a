"""What evaluate.py measures: a finished run, a checkpoint or a file of Gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict

from asysplat.errors import InputError
from asysplat.training.ranges import check_ranges
from asysplat.training.runs import RESULTS, content_of, describe_run, find_runs, hash_of

OWN_OPTIONS = ("run", "scene", "steps")  # the others are train.py's


@dataclass(frozen=True)
class Subject:
    """What is measured, and where the results go.

    Args:
        config: of the data, the model and the metrics, as train.py takes it; its init_path names
            the weights.
        folder: for the results.
        described: what the results depend on: results of other values are not these.
    """

    config: DictConfig
    folder: Path
    described: dict[str, str | int]

    @property
    def kept(self) -> Path:
        """The folder of the results of single scenes; another for everything `described`."""
        return self.folder / "evaluation" / hash_of(self.described)


def find_subject(options: DictConfig, overrides: Sequence[str]) -> Subject:
    """Find what the options of evaluate.py name.

    Args:
        options: conf/evaluate.yaml.
        overrides: of the command.

    Raises:
        InputError: none of run, init_path and scene is given, or several are; files are not there;
            options that do not go with a run; a value that is missing or out of range.
    """
    named = [name for name in ("run", "init_path", "scene") if options[name] is not None]
    if len(named) != 1:
        raise InputError(
            f"{' and '.join(named) or 'nothing'} is given to evaluate: give one of run=last, "
            "init_path=shipped and scene=scene.ply."
        )
    if options.run is not None:
        return _of_run(options, overrides)
    config = options.copy()
    with open_dict(config):
        del config["run"], config["scene"]
    for key in OmegaConf.missing_keys(config):
        raise InputError(f"{key} is not set: add {key}=... to the command.")
    # Its `steps` are not train.py's.
    check_ranges(OmegaConf.masked_copy(config, [key for key in config if key != "steps"]))
    described = _describe(config, options)
    stem = Path(options.scene or options.init_path).stem
    folder = Path(options.paths.logs) / "evaluate" / f"{stem}-{hash_of(described)[:8]}"
    return Subject(config, folder, described)


def _of_run(options: DictConfig, overrides: Sequence[str]) -> Subject:
    """Take a run as it was tested: what evaluate.py adds to it stands beside its own results."""
    folder = Path(options.run)
    if options.run == "last":
        runs = [run.folder for run in find_runs(Path(options.paths.logs))]
        if not runs:
            raise InputError(
                f"run=last found no finished run in {options.paths.logs}: name its folder, or set "
                "paths.logs=."
            )
        folder = runs[-1]
    checkpoint = folder / "checkpoints" / "last.ckpt"
    for path in (folder / RESULTS, folder / "config.yaml", checkpoint):
        if not path.is_file():
            raise InputError(
                f"run={options.run} has no {path.relative_to(folder)}: name the folder of a "
                "finished run, or last."
            )
    keys = [override.partition("=")[0].lstrip("+~") for override in overrides]
    foreign = [key for key in keys if key not in OWN_OPTIONS and not key.startswith("paths.")]
    if foreign:
        raise InputError(
            f"{foreign[0]} does not go with run={options.run}, which is measured as it was tested: "
            f"leave it out, or give init_path={checkpoint} and the run's options in place of run."
        )
    config = OmegaConf.load(folder / "config.yaml")
    config.init_path = str(checkpoint)
    return Subject(config, folder, _describe(config, options))


def _describe(config: DictConfig, options: DictConfig) -> dict[str, str | int]:
    """Describe what results depend on, by keys that are not those of a run's own results."""
    described = describe_run(config)
    described = {f"evaluation/{k.removeprefix('run/')}": v for k, v in described.items()}
    described["evaluation/steps"] = str(options.steps)
    if options.scene is not None:
        described["evaluation/scene"] = content_of(options.scene)
    return described
