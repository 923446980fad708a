"""The revision of the code."""

import hashlib
import subprocess
from functools import cache

from asysplat.root import ROOT, __version__

CODE = ("asysplat", "conf", "train.py")


@cache
def revision() -> str:
    """Return the git commit of the code that this process runs.

    If tracked files of CODE differ from the commit, "+" and a hash of the differences follow. A
    package outside a repository of its own gives its version instead.
    """
    commit = _git("rev-parse", "--short=12", "HEAD")
    changes = _git("diff", "HEAD", "--", *CODE)
    # A package installed below somebody else's repository is not part of it.
    if _git("rev-parse", "--show-cdup") != b"\n" or commit is None or changes is None:
        return __version__ if __version__ == "unknown" else f"version {__version__}"
    mark = f"+{hashlib.sha256(changes).hexdigest()[:8]}" if changes else ""
    return commit.decode().strip() + mark


def _git(*arguments: str) -> bytes | None:
    """Return what git prints; None if it fails or is not installed."""
    try:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
