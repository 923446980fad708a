"""The version, and where the files beside the code are: configurations, weights, scripts."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = Path(__file__).parent
# A wheel carries what lies beside the package in a repository; see pyproject.toml.
INSTALLED = PACKAGE / "installed"
ROOT = INSTALLED if INSTALLED.is_dir() else PACKAGE.parent
CONF = ROOT / "conf"
CHECKPOINTS = ROOT / "checkpoints"
try:
    __version__ = version("asysplat")
except PackageNotFoundError:  # a copy that is not installed
    __version__ = "unknown"


def typed(script: str) -> str:
    """Return how the command of a script is typed here: `python train.py`, or `asysplat train`."""
    return f"python {script}.py" if Path.cwd() == ROOT else f"asysplat {script}"
