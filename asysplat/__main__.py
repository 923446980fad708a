"""All commands of the project by one name.

asysplat reconstruct my_scene
"""

import difflib
import os
import shlex
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
    "cameras": ("asysplat.data.cameras", "find the cameras of photographs"),
    "train": ("train.py", "train and test a model, or all models of a table"),
    "evaluate": ("evaluate.py", "measure a model, or files of Gaussians"),
    "report": ("report.py", "finished runs beside the paper's tables"),
    "benchmark": ("benchmark.py", "run time against error"),
    "doctor": ("asysplat.doctor", "what this machine has, and what is missing"),
}
COMPLETION = ("-sc", "--shell-completion")


def main() -> None:
    """Start the command that the first word names, with the other words."""
    name, *words = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
    elif name == "--version":
        print(__version__)
    elif name in COMPLETION:
        complete(words)
    elif name in COMMANDS:
        start(name, words)
    else:
        nearest = difflib.get_close_matches(name, COMMANDS, 1) or COMMANDS
        sys.exit(f"error: {name} is unknown: did you mean asysplat {' or '.join(nearest)}?")


def usage() -> str:
    """Write the commands, a line each."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {purpose}" for name, (_, purpose) in COMMANDS.items()]
    return "\n".join(
        [
            "asysplat COMMAND [option=value ...]",
            *("", *lines, ""),
            'asysplat COMMAND --help shows its options; eval "$(asysplat -sc install=bash)" '
            "completes them.",
        ]
    )


def start(name: str, words: Sequence[str]) -> None:
    """Replace this process by a command's own, so that signals and exit status are its own."""
    target, _ = COMMANDS[name]
    # -P: a module of the working directory does not hide an installed one.
    code = [str(ROOT / target)] if target.endswith(".py") else ["-P", "-m", target]
    os.execv(sys.executable, [sys.executable, *code, *words])


def complete(words: Sequence[str]) -> None:
    """Complete the first word by the commands, and the others by Hydra's own completion."""
    line = os.environ.get("COMP_LINE", "")
    typed = shlex.split(line) + [""] * line.endswith(" ")
    if len(typed) > 2 and typed[1] in COMMANDS and COMMANDS[typed[1]][0].endswith(".py"):
        # Hydra's completion knows lines without the command.
        rest = line.split(typed[1], 1)[1].lstrip()
        os.environ["COMP_LINE"] = f"asysplat {rest}"
        start(typed[1], [COMPLETION[0], *words])
    if not line:  # install=bash
        import hydra

        hydra.main(version_base="1.3")(lambda _: None)()
    elif len(typed) == 2:
        print(" ".join(name for name in COMMANDS if name.startswith(typed[1])))


if __name__ == "__main__":
    handle_signals()
    main()
