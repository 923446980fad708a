"""Check the overrides of a command line before Hydra reads them."""

import contextlib
import difflib
import os
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, RangeSweep
from hydra.errors import HydraException
from omegaconf import OmegaConf

from asysplat.errors import InputError
from asysplat.root import CONF, typed

SWITCHES = ("--view", "--open")  # of reconstruct.py, each for an option that is true
MIN_SIMILARITY = 0.8  # difflib's ratio of widht and width


def check_overrides(overrides: Iterable[str], script: str = "train") -> None:
    """Check that each override sets an existing option or an existing choice of a group.

    Args:
        overrides: `key=value`, in Hydra's syntax; Hydra's own options are not checked.
        script: name of the configuration file in conf/.
    """
    composed, settings = [], []
    for override in map(_parse, overrides):
        key = override.key_or_group
        if key.startswith("hydra"):
            continue
        group = (CONF / key).is_dir()
        if group and not override.is_delete():
            _check_choices(override)
        adds = override.is_add() or override.is_force_add()
        (composed if group or adds else settings).append(override)
    if not settings:
        return
    config = _compose(script, composed)
    options = set(_paths(config))
    for override in settings:
        key = override.key_or_group
        if key not in options:
            raise InputError(f"{key} is unknown: {_hint(key, options, script)}")
        for stage in _values(override) if key == "stage" else ():
            if stage not in config["stages"]:
                *stages, last = config["stages"]
                raise InputError(f"stage={stage} is unknown: choose {', '.join(stages)} or {last}.")


def as_overrides(words: list[str]) -> list[str]:
    """Rewrite the first word as path=..., --view as view=true and --open as open=true."""
    switches = [f"{word[2:]}=true" for word in words if word in SWITCHES]
    words = [word for word in words if word not in SWITCHES]
    if words and not words[0].startswith("-") and ("=" not in words[0] or Path(words[0]).exists()):
        words[0] = f"path={_quote(words[0])}"
    return words + switches


def quote_paths(words: Iterable[str]) -> list[str]:
    """Quote existing paths that Hydra cannot read otherwise, as run=logs/0_model=longlrm."""
    quoted = []
    for word in words:
        key, _, value = word.partition("=")
        if value and os.path.exists(value):
            try:
                _parse(word)
            except InputError:
                word = f"{key}={_quote(value)}"
        quoted.append(word)
    return quoted


def _quote(value: str) -> str:
    # Hydra unescapes a backslash only before a quote.
    escaped = re.sub(r"(\\+)(?='|$)", r"\1\1", value).replace("'", "\\'")
    return f"'{escaped}'"


def _parse(override: str) -> Override:
    key, equals, _ = override.partition("=")
    if not (key and equals) and not override.startswith("~"):
        raise InputError(
            f"{override} sets nothing: write {override}=value, or ~{override} to leave it out."
        )
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException:
        raise InputError(
            f"{override} cannot be read: a value that holds brackets, quotes or = needs quotes of "
            """its own within those of the shell, as in 'data.root="my (scene)"'."""
        ) from None


def _check_choices(override: Override) -> None:
    group = override.key_or_group
    folder = CONF / group
    known = sorted(path.stem for path in folder.glob("*.yaml"))
    choices = (choice for value in _values(override) for choice in value.strip("[]").split(","))
    for choice in choices:
        if choice and choice not in known:
            nearest = difflib.get_close_matches(choice, known, n=3, cutoff=0.5) or known
            raise InputError(
                f"{group}={choice} is unknown: did you mean {', '.join(nearest)}? "
                f"All are in {folder.relative_to(CONF.parent)}/."
            )


def _values(override: Override) -> list[str]:
    """Return the values as typed; for a sweep that lists its values, all of them."""
    if not override.is_sweep_override():
        return [override.get_value_element_as_str()]
    listed = isinstance(override.value(), ChoiceSweep | RangeSweep)
    return list(override.sweep_string_iterator()) if listed else []


def _compose(script: str, overrides: Sequence[Override]) -> dict:
    """Compose the configuration with these overrides, with the first value of each sweep."""
    lines = [override.input_line for override in overrides if override.is_delete()]
    for override in overrides:
        if not override.is_delete():
            lines += [f"{override.get_key_element()}={value}" for value in _values(override)[:1]]
    with contextlib.ExitStack() as stack:
        if not GlobalHydra.instance().is_initialized():
            stack.enter_context(hydra.initialize_config_dir(str(CONF), version_base="1.3"))
        try:
            return OmegaConf.to_container(hydra.compose(script, lines))
        except HydraException as error:
            raise InputError(f"{' '.join(lines)}: {str(error).splitlines()[0]}") from error


def _paths(config: dict, prefix: str = "") -> Iterator[str]:
    for key, value in config.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from _paths(value, f"{prefix}{key}.")


def _hint(key: str, known: Collection[str], script: str) -> str:
    if nearest := _nearest(key, known):
        return f"did you mean {nearest}?"
    group = key.partition(".")[0]
    choices = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    having = [c for c in choices if key in _paths(_compose(script, [_parse(f"{group}={c}")]))]
    if having:
        return f"it is an option of {group}={', '.join(having)}."
    return f"{typed(script)} --cfg job shows all."


def _nearest(key: str, known: Collection[str]) -> str | None:
    """Return the option that is spelled like `key`, in whole or from one of its dots on."""
    name = key.rpartition(".")[2]
    top = [path for path in known if "." not in path]
    top += [str(folder.relative_to(CONF)) for folder in CONF.rglob("*") if folder.is_dir()]
    if nearest := difflib.get_close_matches(key, top, 1, MIN_SIMILARITY):
        return nearest[0]
    if name in known:  # at the top: steps for trainer.steps
        return name
    ends: dict[str, str] = {}
    for path in sorted(known, key=lambda path: (path.count("."), len(path), path)):
        parts = path.split(".")
        for start in range(len(parts)):
            ends.setdefault(".".join(parts[start:]), path)
    nearest = difflib.get_close_matches(key, ends, 1, MIN_SIMILARITY)
    return ends[nearest[0]] if nearest else None
