"""2,000 photographs, and photographs of 50 megapixels, in 4 GB: a scene or a sentence, no kill.

The limit is that of a process's own data (`ulimit -d`), of which libraries take some.
"""

import json
import os
import resource
import subprocess
import sys

import pytest
from PIL import Image

from asysplat.data import ProceduralScene
from asysplat.data.write import write_transforms

LIMIT = 4 * 2**30  # bytes
SIZE = (64, 96)  # height, width
ENLARGED = 90  # 5760 x 8640: 50 megapixels

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


@pytest.fixture
def reconstruct(repository, tmp_path):
    """Runs reconstruct.py under the limit; returns exit code and errors."""

    def run(*options) -> tuple[int, str]:
        command = [sys.executable, "reconstruct.py", *map(str, options), f"paths.logs={tmp_path}"]
        done = subprocess.run(
            command,
            cwd=repository,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (LIMIT, LIMIT)),
            capture_output=True,
            text=True,
        )
        return done.returncode, done.stderr

    return run


def write_scene(folder, count) -> None:
    write_transforms(ProceduralScene(0, *SIZE, count).views(range(count)), folder)


def enlarge(folder) -> None:
    """Enlarge the photographs of a scene, and the numbers of its cameras."""
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    for numbers in (content, *content["frames"]):
        for key in {"w", "h", "fl_x", "fl_y", "cx", "cy"} & numbers.keys():
            numbers[key] *= ENLARGED
    for frame in content["frames"]:
        frame.pop("depth_file_path", None)
        image = folder / frame["file_path"]
        frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
        with Image.open(image) as small:
            large = small.resize((content["w"], content["h"]), Image.Resampling.BICUBIC)
        large.save(folder / frame["file_path"])
        image.unlink()
    file.write_text(json.dumps(content))


def test_fifty_megapixels(reconstruct, tmp_path):
    write_scene(tmp_path / "large", 12)
    enlarge(tmp_path / "large")
    code, _ = reconstruct(tmp_path / "large", "cameras=given", "seconds=5", "height=1080")
    assert code == 0
    before = sorted(tmp_path.rglob("*"))
    code, errors = reconstruct(tmp_path / "large", "cameras=given", "seconds=5", "height=5760")
    assert code == 1 and errors.startswith("error: there is no memory left"), errors
    assert errors.count("\n") == 1 and sorted(tmp_path.rglob("*")) == before


def test_two_thousand_photographs(reconstruct, tmp_path):
    write_scene(tmp_path / "many", 2000)
    for views in (128, "null"):  # the default, and as many as 2 GB hold
        options = ("cameras=given", "seconds=5", f"height={SIZE[0]}", f"views={views}")
        code, errors = reconstruct(tmp_path / "many", *options)
        assert code == 0, errors
