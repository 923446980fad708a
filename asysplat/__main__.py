"""All commands of the project by one name.

asysplat reconstruct my_scene
"""

import difflib
import os
import sys
from collections.abc import Sequence

from asysplat.interrupts import handle_signals
from asysplat.root import ROOT, __version__

# Word: the script or module that it starts, and what it does.
COMMANDS = {
    "reconstruct": ("reconstruct.py", "photographs, or a video, to a scene of Gaussians"),
    "view": ("asysplat.export.viewer", "a scene of Gaussians in the browser"),
    "export": ("asysplat.export", "a scene of Gaussians in another format, or smaller"),
    "check": ("asysplat.data.check", "do the cameras of a scene fit its images?"),
    "prepare": ("asysplat.data.prepare", "scenes for training: small files that are read fast"),
    "cameras": ("asysplat.data.cameras", "find the cameras of photographs"),
    "train": ("train.py", "train and test a model, or all models of a table"),
    "import": ("asysplat.import_weights", "weights that Long-LRM's public code trained"),
    "evaluate": ("evaluate.py", "measure a model, or files of Gaussians"),
    "report": ("report.py", "finished runs beside the paper's tables"),
    "benchmark": ("benchmark.py", "run time against error"),
    "doctor": ("asysplat.doctor", "what this machine has, and what is missing"),
}


def main() -> None:
    """Start the command that the first word names, with the other words."""
    name, *words = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
    elif name == "--version":
        print(__version__)
    elif name in COMMANDS:
        start(name, words)
    else:
        nearest = difflib.get_close_matches(name, COMMANDS, 1) or COMMANDS
        sys.exit(f"error: {name} is unknown: did you mean asysplat {' or '.join(nearest)}?")


def usage() -> str:
    """Write the commands, a line each."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {purpose}" for name, (_, purpose) in COMMANDS.items()]
    ending = "asysplat COMMAND --help shows its options."
    return "\n".join(["asysplat COMMAND [option=value ...]", "", *lines, "", ending])


def start(name: str, words: Sequence[str]) -> None:
    """Replace this process by a command's own, so that signals and exit status are its own."""
    target, _ = COMMANDS[name]
    # -P: a module of the working directory does not hide an installed one.
    code = [str(ROOT / target)] if target.endswith(".py") else ["-P", "-m", target]
    os.execv(sys.executable, [sys.executable, *code, *words])


if __name__ == "__main__":
    handle_signals()
    main()
