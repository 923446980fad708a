"""Where the files beside the code are: configurations, shipped weights, scripts."""

from pathlib import Path

PACKAGE = Path(__file__).parent
# A wheel carries what lies beside the package in a repository; see pyproject.toml.
INSTALLED = PACKAGE / "installed"
ROOT = INSTALLED if INSTALLED.is_dir() else PACKAGE.parent
CONF = ROOT / "conf"
CHECKPOINTS = ROOT / "checkpoints"


def typed(script: str) -> str:
    """Return how the command of a script is typed here: `python train.py`, or `asysplat train`."""
    return f"python {script}.py" if Path.cwd() == ROOT else f"asysplat {script}"
