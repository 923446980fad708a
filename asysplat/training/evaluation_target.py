"""Find what evaluate.py measures: a finished run, a checkpoint or a file of Gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict

from asysplat.errors import InputError
from asysplat.training.ranges import check_ranges
from asysplat.training.run_config import read_config
from asysplat.training.runs import RESULTS, content_of, describe_run, find_runs, hash_of

OWN_OPTIONS = ("run", "scene", "steps")  # the others are train.py's


@dataclass(frozen=True)
class EvaluationTarget:
    """What an evaluation measures."""

    config: DictConfig  # as train.py takes it; its init_path names the weights
    folder: Path  # for the results
    described: dict[str, str | int]  # everything that the results depend on

    @property
    def scene_folder(self) -> Path:
        """The folder of the results of single scenes, another for everything `described`."""
        return self.folder / "evaluation" / hash_of(self.described)


def find_target(options: DictConfig, overrides: Sequence[str]) -> EvaluationTarget:
    """Find the target of evaluate.py from its options and the overrides of its command.

    Raises:
        InputError: none of run, init_path and scene is given, or several are; files do not exist;
            options that do not go with a run; a value that is missing or out of range.
    """
    given = [name for name in ("run", "init_path", "scene") if options[name] is not None]
    if len(given) != 1:
        raise InputError(
            f"{' and '.join(given) or 'nothing'} is given to evaluate: give one of run=last, "
            "init_path=shipped and scene=scene.ply."
        )
    if options.scene is not None and not any(each.startswith("data") for each in overrides):
        raise InputError(
            f"scene={options.scene} is measured on photographs of the same scene: add data=files "
            "data.root=my_scene."
        )
    if options.run is not None:
        return _target_of_run(options, overrides)
    config = options.copy()
    with open_dict(config):
        del config["run"], config["scene"]
    for key in OmegaConf.missing_keys(config):
        raise InputError(f"{key} is not set: add {key}=... to the command.")
    # `steps` is another option in train.py.
    check_ranges(OmegaConf.masked_copy(config, [key for key in config if key != "steps"]))
    described = _describe(config, options)
    stem = Path(options.scene or options.init_path).stem
    folder = Path(options.paths.logs) / "evaluate" / f"{stem}-{hash_of(described)[:8]}"
    return EvaluationTarget(config, folder, described)


def _target_of_run(options: DictConfig, overrides: Sequence[str]) -> EvaluationTarget:
    """Take a run with its own options; the evaluation is written beside its results."""
    folder = Path(options.run)
    if options.run == "last":
        runs = list(find_runs(Path(options.paths.logs)))
        if not runs:
            raise InputError(
                f"run=last found no finished run in {options.paths.logs}: name its folder, or set "
                "paths.logs=."
            )
        folder = runs[-1].folder
    checkpoint = folder / "checkpoints" / "last.ckpt"
    for path in (folder / RESULTS, folder / "config.yaml", checkpoint):
        if not path.is_file():
            raise InputError(
                f"run={options.run} has no {path.relative_to(folder)}: name the folder of a "
                "finished run, or last."
            )
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
    described["evaluation/steps"] = str(options.steps)
    if options.scene is not None:
        described["evaluation/scene"] = content_of(options.scene)
    return described
