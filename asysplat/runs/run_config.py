"""Read the configuration of a run and take it apart."""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from asysplat.errors import InputError
from asysplat.root import CONF


def read_config(path: Path) -> DictConfig:
    """Read the config.yaml of a run; Hydra calls any `_target_`, so only those of conf/ pass."""
    try:
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OSError, yaml.YAMLError, OmegaConfBaseException) as error:
        reason = str(error).split("\n")[0]
        raise InputError(f"{path} cannot be read ({reason}): copy the run again.") from error
    if not isinstance(content, dict) or not content:
        raise InputError(f"{path} is not the configuration of a run: copy the run again.")
    _check_targets(path, content)
    return OmegaConf.create(content)


def _check_targets(path: Path, node: object, key: str = "") -> None:
    if isinstance(node, list):
        node = dict(enumerate(node))
    for name, value in node.items() if isinstance(node, dict) else ():
        inner = f"{key}.{name}".removeprefix(".")
        if name == "_target_" and str(value) not in _known_targets():
            raise InputError(
                f"{path}: {inner} is {value}, which no file of conf/ names: a run may build only "
                "those classes; if it is one of yours, name it there."
            )
        _check_targets(path, value, inner)


@cache
def _known_targets() -> set[str]:
    files = CONF.rglob("*.yaml")
    return {name for file in files for name in re.findall(r"_target_: *(\S+)", file.read_text())}


def plain_options(config: DictConfig) -> dict[str, Any]:
    """Return a configuration as nested dictionaries and lists, with resolved interpolations."""
    # OmegaConf's types are those of any node: a DictConfig gives a dict.
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))


def flat_options(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested options by their dotted keys."""
    flat = {}
    for key, value in options.items():
        nested = isinstance(value, Mapping)
        flat |= flat_options(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return flat
