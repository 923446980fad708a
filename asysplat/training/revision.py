"""Which code a run was made with."""

import hashlib
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CODE = ("asysplat", "conf", "sweeps", "train.py")


@cache
def revision() -> str:
    """The git commit of the code that this process runs, and where files of CODE that git knows
    differ from it, "+" and a hash of the differences. Outside of a repository of its own, the
    package's version."""
    # A package that is installed below somebody else's repository is no part of it.
    if _git("rev-parse", "--show-cdup") != b"\n":
        return _version()
    commit = _git("rev-parse", "--short=12", "HEAD")
    changes = _git("diff", "HEAD", "--", *CODE)
    if commit is None or changes is None:
        return _version()
    mark = f"+{hashlib.sha256(changes).hexdigest()[:8]}" if changes else ""
    return commit.decode().strip() + mark


def _git(*words: str) -> bytes | None:
    """What git prints; None where it fails or is not installed."""
    try:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None


def _version() -> str:
    try:
        return f"version {version('asysplat')}"
    except PackageNotFoundError:
        return "unknown"
