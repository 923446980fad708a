"""Go on from where a finished reconstruction ended."""

from collections.abc import Collection
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from asysplat.errors import InputError
from asysplat.runs.run_config import read_config
from asysplat.runs.runs import RESULTS, SCENE, find_reconstructions, folder_of

OF_PHOTOGRAPHS = ("path", "layout", "cameras", "frames", "on_error", "masks", "background")
OF_PHOTOGRAPHS += ("height", "width", "views", "held_out_every", "max_held_out")
OF_QUALITY = ("height", "views", "cameras")  # those that quality= sets


def continue_run(config: DictConfig, options: Collection[str]) -> DictConfig:
    """Take the photographs and the scene of the reconstruction `config.run`, which may be None.

    The refinement then begins at full resolution. The options of the command line stay. Nothing
    else is taken: a run may come from a stranger.
    """
    if config.run is None:
        return config
    files = (RESULTS, "config.yaml", SCENE)
    folder = folder_of(config.run, Path(config.paths.logs), find_reconstructions, files)
    file = folder / "config.yaml"
    stored = read_config(file)
    taken = {key: stored[key] for key in OF_PHOTOGRAPHS if key in stored}
    if not isinstance(taken.get("path"), str):
        raise InputError(f"{file} has no path of photographs: name the folder of a reconstruction.")
    for key, value in taken.items():
        if key != "background" and not isinstance(value, str | int | None):  # that may be a list
            raise InputError(f"{file}: {key} is {value}: expected a word or a whole number.")
    taken |= {"run": str(folder), "init": str(folder / SCENE)}
    taken |= {"refinement.half_resolution_until": 0.0}
    kept = {*options, *(OF_QUALITY if "quality" in options else ())} - {"run"}
    config = config.copy()
    for key, value in taken.items():
        if key not in kept:
            OmegaConf.update(config, key, value)
    print(f"goes on from {folder}, on the photographs {config.path}")
    return config
