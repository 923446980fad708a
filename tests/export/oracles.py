"""Other programs that read and write Gaussians, where Node.js and their packages are present."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

VALIDATE = """
const [folder, file] = process.argv.slice(1);
const content = new Uint8Array(require("fs").readFileSync(file));
require(folder).validateBytes(content, {maxIssues: 0}).then(
  report => console.log(JSON.stringify(report.issues.messages)));
"""
SPLAT_TRANSFORM = "@playcanvas/splat-transform"


def package(name: str) -> Path:
    """The folder of a package of Node.js; a test that asks for it is skipped without."""
    modules = os.environ.get("ASYSPLAT_NODE_MODULES")
    if modules is None or shutil.which("node") is None:
        pytest.skip("needs Node.js, and ASYSPLAT_NODE_MODULES: a folder node_modules")
    folder = Path(modules) / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent: npm install {name}")
    return folder


def run_node(*words: str | Path) -> str:
    command = ["node", *map(str, words)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=300).stdout


def splat_transform(source: Path, target: Path, *options: str) -> Path:
    """Convert a file by PlayCanvas's program, which picks formats by suffix; return the new one."""
    folder = package(SPLAT_TRANSFORM)
    version = json.loads((folder / "package.json").read_text())["version"]
    if not version.startswith("2."):  # the next one reads SPZ in other axes than its format's
        pytest.skip(f"splat-transform is {version}: npm install {SPLAT_TRANSFORM}@2")
    words = (folder / "bin" / "cli.mjs", "--quiet", "--overwrite", "--gpu", "cpu")
    run_node(*words, *options, source, target)
    return target


def gltf_errors(file: Path) -> list[str]:
    """Return what Khronos's validator finds wrong, with the places."""
    found = json.loads(run_node("-e", VALIDATE, package("gltf-validator"), file))
    return [f"{issue['message']} {issue['pointer']}" for issue in found if issue["severity"] == 0]
