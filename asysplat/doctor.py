"""What this machine has for the project, and what is missing: `asysplat doctor`.

Its lines are what a report of a problem needs.
"""

import os
import platform
import re
import shutil
import sys
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement

from asysplat.interrupts import handle_signals
from asysplat.root import ROOT, __version__
from asysplat.runs.machine import revision

EXTRAS = {
    "viewer": "asysplat view, view=true",
    "video": "videos, in and out",
    "heif": "photographs as phones save them",
    "masks": "masks=find",
    "matching": "cameras where SIFT fails",
    "mesh": "meshes of scenes",
    "spz": "SPZ of version 4",
    "sweeps": "sweeps on several processes, or on SLURM",
    "disparity": "asysplat prepare --disparities",
    "wandb": "logger=wandb",
}


def main() -> None:
    """Print the machine, the versions and the missing parts; exit with 1 if one is required."""
    missing = sorted(str(needed) for needed in requirements() if not is_installed(needed))
    lines = describe()
    for extra, purpose in EXTRAS.items():
        installed = all(map(is_installed, requirements(extra) - requirements()))
        lines[extra] = purpose if installed else f"pip install 'asysplat[{extra}]': {purpose}"
    width = max(map(len, lines))
    for name, text in lines.items():
        print(f"{name:{width}}  {text}".rstrip())
    if missing:
        sys.exit(f"missing: {', '.join(missing)}; pip install --upgrade asysplat")


def describe() -> dict[str, str]:
    """Describe the project's copy, Python, torch, the processor, the memory and the GPUs."""
    cache, home = Path.home() / ".cache" / "asysplat", shutil.disk_usage(Path.home())
    lines = {
        "asysplat": f"{__version__}, {revision()}, in {ROOT}",
        "python": f"{platform.python_version()}, {sys.executable}",
        "system": platform.platform(),
        "processor": f"{processor()}, {os.cpu_count()} cores",
        "disk": f"{home.free / 1e9:.0f} GB free at home; compiled kernels are in {cache}",
    }
    if find_spec("torch") is None:
        return lines
    import torch

    from asysplat.evaluation.measured_cost import memory_gb

    lines["memory"] = f"{memory_gb('cpu'):.0f} GB"
    if Path("/dev/shm").is_dir():
        shared = shutil.disk_usage("/dev/shm").free / 1e9
        lines["/dev/shm"] = f"{shared:.0f} GB free, for what loads data: see train.py's plan"
    lines["torch"] = f"{torch.__version__}, {torch.get_num_threads()} threads"
    lines["kernels"] = ", ".join(
        f"{name} {version(name)}" for name in ("numba", "triton") if find_spec(name)
    )
    lines["gpu"] = "none: commands run on the processor"
    for index in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(index)
        lines["gpu" if not index else f"gpu {index}"] = (
            f"{card.name}, {memory_gb(f'cuda:{index}'):.0f} GB, compute capability "
            f"{card.major}.{card.minor}, CUDA {torch.version.cuda}"
        )
    return lines


def processor() -> str:
    """Return the processor's name."""
    info = Path("/proc/cpuinfo")  # Linux alone
    model = info.exists() and re.search(r"model name\s*:\s*(.+)", info.read_text())
    return model[1] if model else platform.processor() or platform.machine()


def requirements(extra: str = "") -> set[Requirement]:
    """Return the packages that the project needs, with an extra those of the extra, too."""
    every = map(Requirement, distribution("asysplat").requires or ())
    return {r for r in every if r.marker is None or r.marker.evaluate({"extra": extra})}


def is_installed(requirement: Requirement) -> bool:
    """Return whether a package is installed in a version that the requirement allows."""
    try:
        return requirement.specifier.contains(version(requirement.name), prereleases=True)
    except PackageNotFoundError:
        return False


if __name__ == "__main__":
    handle_signals()
    main()
