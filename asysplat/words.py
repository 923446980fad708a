"""Words of a command that name a file of conf/ or sweeps/, checked before Hydra reads them."""

import difflib
import sys
from collections.abc import Iterable
from pathlib import Path

from asysplat.errors import InputError

ROOT = Path(__file__).parents[1]
SWEEPS = "sweeps"


def check_words(words: Iterable[str]) -> None:
    """Raise InputError for a `group=choice` whose choice is no file, naming the nearest ones."""
    for word in words:
        group, equals, choices = word.lstrip("+").partition("=")
        folder = _folder(group)
        if not equals or folder is None:
            continue
        known = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
        for choice in choices.strip("[]").split(","):
            if choice not in known and choice not in ("null", ""):
                nearest = difflib.get_close_matches(choice, known, n=3, cutoff=0.4) or known
                raise InputError(
                    f"{group}={choice} is unknown: did you mean {', '.join(nearest)}? "
                    f"All are in {folder.relative_to(ROOT)}/."
                )


def exit_at_unknown_words() -> None:
    """`check_words` of this process's command line; a mistake ends the process."""
    try:
        check_words(sys.argv[1:])
    except InputError as error:
        sys.exit(f"error: {error}")


def _folder(group: str) -> Path | None:
    """Where the choices of a group are; None for what is no group of ours."""
    if group == SWEEPS:
        return ROOT / SWEEPS
    folder = ROOT / "conf" / group
    return folder if group and not group.startswith("hydra") and folder.is_dir() else None
