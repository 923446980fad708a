"""Compose the configuration of a command line, before the script imports torch."""

import difflib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, RangeSweep
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from asysplat.errors import InputError
from asysplat.root import CONF

MIN_SIMILARITY = 0.8  # difflib's ratio of widht and width


def check_overrides(overrides: Iterable[str], script: str = "train") -> DictConfig:
    """Compose a configuration; the error of an unknown option or choice names the nearest.

    Of a sweep each value is composed once, with some of the others; Hydra's options are left out.
    """
    parsed = [_parse(word) for word in overrides if not word.lstrip("+~").startswith("hydra")]
    lines = [values for values in map(_values, parsed) if values]
    with ExitStack() as stack:
        if not GlobalHydra.instance().is_initialized():
            stack.enter_context(hydra.initialize_config_dir(str(CONF), version_base="1.3"))
        for number in range(max(map(len, lines), default=1)):
            words = [values[min(number, len(values) - 1)] for values in lines]
            try:
                config = hydra.compose(script, words)
            except HydraException as error:
                sentence = str(error).splitlines()[0].removesuffix(".")
                raise InputError(sentence + _hint(sentence, script)) from error
            if "stage" in config and config.stage not in config.stages:
                known = ", ".join(config.stages)
                raise InputError(f"stage={config.stage} is unknown: choose from {known}.")
    return config


def split_paths(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line after its first words that are paths, not options."""
    paths = takewhile(lambda x: x[:1] != "-" and ("=" not in x or Path(x).exists()), words)
    return (found := list(paths)), list(words[len(found) :])


def path_option(name: str, path: str) -> str:
    """Write an option whose value is a path, quoted as Hydra reads it."""
    return f"{name}={_quote(path)}"


def quote_paths(words: Iterable[str]) -> list[str]:
    """Quote existing paths that Hydra cannot read otherwise, as run=logs/0_model=longlrm."""
    quoted = []
    for word in words:
        key, _, value = word.partition("=")
        if value and os.path.exists(value):
            try:
                _parse(word)
            except InputError:
                word = path_option(key, value)
        quoted.append(word)
    return quoted


def _quote(value: str) -> str:
    # Hydra unescapes a backslash only before a quote.
    escaped = re.sub(r"(\\+)(?='|$)", r"\1\1", value).replace("'", "\\'")
    return f"'{escaped}'"


def _parse(override: str) -> Override:
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException:
        raise InputError(
            f"{override} cannot be read: write option=value; a value that holds brackets, quotes "
            """or = needs quotes of its own within those of the shell: 'data.root="my (scene)"'."""
        ) from None


def _values(override: Override) -> list[str]:
    """Return an override for each value of its sweep; none if they are not listed."""
    if not override.is_sweep_override():
        return [override.input_line]
    listed = isinstance(override.value(), ChoiceSweep | RangeSweep)
    key = override.get_key_element()
    return [f"{key}={value}" for value in override.sweep_string_iterator()] if listed else []


def _hint(sentence: str, script: str) -> str:
    """Return the choice or option that ends like the last name in Hydra's sentence."""
    missing = sentence.split("'")[-2]
    files = [path.relative_to(CONF).with_suffix("") for path in CONF.rglob("*.yaml")]
    if "/" in missing:
        names = [str(file) for file in files]
    else:
        names = [*_paths(OmegaConf.to_container(hydra.compose(script)))]
        names += {str(file.parent) for file in files}
    names.sort(key=lambda name: name.count("."))
    ends = {re.split("[./]", name)[-1]: name for name in reversed(names)}
    end = re.split("[./]", missing)[-1]
    for known in ([name for name in names if name in ends], ends):  # the top's first
        if nearest := difflib.get_close_matches(end, known, 1, MIN_SIMILARITY):
            return f": did you mean {ends[nearest[0]]}?"
    return "."


def _paths(config: dict, prefix: str = "") -> Iterator[str]:
    for key, value in config.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _paths(value, f"{prefix}{key}.")
