"""Other programs that read and write our formats, where they are installed."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

NODE_MODULES = "ASYSPLAT_NODE_MODULES"  # a folder in which npm installed the programs


def node_module(name: str) -> Path:
    """Return the folder of a package of npm; skip the test where there is none."""
    folder = Path(os.environ.get(NODE_MODULES, "node_modules")) / name
    if shutil.which("node") is None or not folder.is_dir():
        pytest.skip(f"{NODE_MODULES} names no folder with {name}: npm install {name}")
    return folder.resolve()


def _splat_transform_command() -> list[str | Path]:
    folder = node_module("@playcanvas/splat-transform")
    version = json.loads((folder / "package.json").read_text())["version"]
    if not version.startswith("2."):
        pytest.skip(f"splat-transform is {version}: npm install @playcanvas/splat-transform@2")
    return ["node", folder / "bin" / "cli.mjs"]


def splat_transform(source: Path, target: Path, *options: str) -> Path:
    """Convert a file with PlayCanvas's splat-transform, and return the new one."""
    words = [*_splat_transform_command(), "-w", "-q", *options, source, target]
    result = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0 and target.exists(), result.stdout + result.stderr
    return target
