"""Read and use the configuration of a run, which may come from another machine.

It must not run code.
"""

import io
import re
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from asysplat.errors import InputError, brief, input_error_behind
from asysplat.files import read_text
from asysplat.root import CONF, ROOT
from asysplat.runs.old_names import upgrade_config

MAX_BYTES, MAX_NODES = 2**20, 100_000  # size of a configuration: ours have 10 KB and 500 values


def read_config(path: Path) -> DictConfig:
    """Read the config.yaml of a run, under today's names.

    Hydra imports and calls whatever a `_target_` names, so only those of conf/ are accepted, and
    for a model, which holds no data and no logger, those of conf/model/. A cache and downloads are
    not the run's to choose: there is no cache, and nothing is downloaded.
    """
    text = read_text(path, MAX_BYTES, "strict")
    try:
        # Without anchors, whose aliases repeat them, the bytes bound the values.
        if "&" in text and _count_nodes(yaml.compose(text, yaml.SafeLoader), {}) > MAX_NODES:
            raise ValueError(f"its aliases make more than {MAX_NODES:,} values")
        content = OmegaConf.to_container(OmegaConf.load(io.StringIO(text)))
    # OSError: neither a dictionary nor a list; ValueError: also an integer of thousands of digits.
    except (OSError, ValueError, RecursionError, yaml.YAMLError, OmegaConfBaseException) as error:
        reason = str(error).split("\n")[0]
        raise InputError(f"{path} cannot be read ({reason}): copy the run again.") from error
    if not isinstance(content, dict) or not content:
        raise InputError(f"{path} is not the configuration of a run: copy the run again.")
    content = upgrade_config(content)
    _check_targets(path, content)
    return OmegaConf.create(_without_caches(content))


@contextmanager
def using_config(path: Path) -> Generator[None]:
    """Name a run's config.yaml in the errors of what is built from it, which are of many kinds."""
    try:
        yield
    except Exception as error:
        mistake = input_error_behind(error)
        if mistake is not None:
            raise InputError(f"{path}: {mistake}") from error
        raise InputError(f"{path} cannot be used ({brief(error)}): copy the run again.") from error


def _count_nodes(node: yaml.Node | None, known: dict[int, int]) -> int:
    """Count the values of a node after its aliases are expanded; `known` has those of others."""
    if node is None or isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = MAX_NODES + 1  # until it is counted: a node may contain itself
        pairs = (
            node.value if isinstance(node, yaml.MappingNode) else [[child] for child in node.value]
        )
        known[id(node)] = 1 + sum(_count_nodes(child, known) for pair in pairs for child in pair)
    return known[id(node)]


def _without_caches(node: Any) -> Any:
    """Return a copy whose caches are null and whose downloads are false."""
    if isinstance(node, list):
        return [_without_caches(value) for value in node]
    if not isinstance(node, dict):
        return node
    fixed = {"cache": None, "download": False}
    return {key: fixed[key] if key in fixed else _without_caches(node[key]) for key in node}


def _check_targets(path: Path, node: object, key: str = "") -> None:
    if isinstance(node, str) and "${" in node:
        raise InputError(
            f"{path}: {key} is {node!r:.200}: a run's configuration has no interpolations."
        )
    if isinstance(node, list):
        node = dict(enumerate(node))
    for name, value in node.items() if isinstance(node, dict) else ():
        inner = f"{key}.{name}".removeprefix(".")
        folder = CONF / "model" if inner.startswith("model.") else CONF
        if name == "_target_" and str(value) not in _known_targets(folder):
            raise InputError(
                f"{path}: {inner} is {value!r:.200}, which no file of {folder.relative_to(ROOT)}/ "
                "names: a run may build only those classes; if it is one of yours, name it there."
            )
        _check_targets(path, value, inner)
        if name == "_args_":
            raise InputError(
                f"{path}: {inner}: a run's configuration names its values, as `cache` and "
                "`download` are not its own."
            )


@cache
def _known_targets(folder: Path) -> set[str]:
    """Return every `_target_` in the files of a folder."""
    files = folder.rglob("*.yaml")
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
