"""Mutants of every file that is read: a sentence or numbers that can be used, and at once.

pytest -m slow -k damaged runs 10,000 of them.
"""

import os
import random
import time
import traceback
import warnings
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from PIL import Image
from test_layouts import NAMES
from torch import nn

from asysplat import load, read_gaussians, write_gaussians
from asysplat.data import SceneOptions, open_scene
from asysplat.data.images import load_image
from asysplat.errors import InputError

SECONDS = 5.0
FEW = 24  # mutants of each kind in the fast test
MANY = 1500
ENDLESS = (os.mkfifo, lambda path: path.symlink_to("/dev/zero"))
BYTES = (
    b"\x00",
    b"\xff" * 8,
    b"9" * 400,
    b"9" * 5000,
    b"/",
    b"-1",
    b"nan",
    b"1e400",
    b"[" * 3000,
    b"\x80",
    b"",
    b'"',
)


def mutate(stored: bytes, numbers: random.Random) -> bytes:
    """Change, insert, repeat or cut bytes."""
    start = numbers.randrange(len(stored) + 1)
    if numbers.random() < 0.3:  # where headers are
        start = numbers.randrange(min(len(stored), 200) + 1)
    end = min(len(stored), start + numbers.choice((0, 1, 2, 8, 100)))
    way = numbers.randrange(4)
    if way == 0:
        return stored[:start]
    if way == 1:
        return stored[:start] + numbers.choice(BYTES) + stored[end:]
    if way == 2:
        return stored[:start] + numbers.randbytes(end - start) + stored[end:]
    return stored[:end] + stored[start:]


def attack(file: Path, read, count: int, seed: str) -> list[str]:
    """Read mutants of a file, and what has no end in its place; return what went wrong."""
    stored, numbers, wrong = file.read_bytes(), random.Random(seed), []
    for index in range(count + len(ENDLESS)):
        if index < count:
            file.write_bytes(mutate(stored, numbers))
        else:
            file.unlink()
            ENDLESS[index - count](file)
        started = time.monotonic()
        try:
            read()
        except InputError:
            pass
        except Exception as error:
            trace = traceback.extract_tb(error.__traceback__)[-1]
            wrong.append(f"{file.name} {index}: {error!r:.200} at {trace.filename}:{trace.lineno}")
        if time.monotonic() - started > SECONDS:
            wrong.append(f"{file.name} {index}: {time.monotonic() - started:.1f} s")
    file.unlink()
    file.write_bytes(stored)
    return wrong


def attack_scene(layout: str, views, folder: Path, count: int) -> list[str]:
    root, wrong = import_module(f"layouts.{layout}").write(views, folder), []

    def read() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sequence = open_scene(root, SceneOptions(24, 32))
            sequence.views(range(2)).validate()
            points = sequence.points
            assert points is None or torch.as_tensor(points).isfinite().all()

    files = sorted(path for path in Path(folder).rglob("*") if path.is_file())
    kinds = {path.suffix: path for path in files}  # one image of many
    for file in {path for path in files if path.suffix not in (".png", ".jpg")} | {*kinds.values()}:
        wrong += attack(file, read, max(1, count // len(files)), f"{layout}{file.name}")
    return wrong


many_mutants = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])


@many_mutants
@pytest.mark.parametrize("layout", NAMES)
def test_damaged_scenes_are_refused_or_usable(layout, few, tmp_path, count):
    assert attack_scene(layout, few, tmp_path / "scene", count) == []


@many_mutants
@pytest.mark.parametrize("suffix", [".ply", ".splat", ".safetensors"])
def test_damaged_gaussians_are_refused_or_usable(suffix, make_scene, tmp_path, count):
    file = tmp_path / f"scene{suffix}"
    if suffix == ".splat":
        file.write_bytes(random.Random(0).randbytes(32 * 20))
    else:
        write_gaussians(file, make_scene(count=20, degree=1, dtype=torch.float32)[0])
    assert attack(file, lambda: read_gaussians(file).validate(), count, suffix) == []


@many_mutants
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_damaged_images_are_refused_or_usable(suffix, tmp_path, count):
    file = tmp_path / f"image{suffix}"
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(file)
    assert attack(file, lambda: load_image(file), count, suffix) == []


@pytest.mark.medium
@many_mutants
def test_damaged_runs_are_refused_or_usable(composed, tmp_path, count):
    """Mutants of the checkpoint and the configuration of a run."""
    sizes = ["model=asysplat_4m4s", "model.layers=1m1s", "width=0.0625", "state_size=4"]
    model = OmegaConf.to_container(composed(*sizes).model, resolve=True)
    checkpoint, config = tmp_path / "checkpoints/last.ckpt", tmp_path / "config.yaml"
    checkpoint.parent.mkdir()
    OmegaConf.save({"model": model}, config)
    weights = nn.ModuleDict({"net": instantiate(model)}).state_dict()
    torch.save({"state_dict": weights}, checkpoint)
    for file in (checkpoint, config):
        assert attack(file, lambda: load(str(checkpoint)), count // 2, file.name) == []


@pytest.mark.parametrize("kind", ["a link to itself", "a link to its folder", "60000 x 1 pixels"])
def test_links_and_sizes_that_no_image_has_are_refused(kind, few, tmp_path):
    root = import_module("layouts.transforms").write(few, tmp_path / "scene")
    image = min(path for path in root.rglob("*.png") if "depth" not in str(path))
    image.unlink()
    if kind == "60000 x 1 pixels":
        Image.new("RGB", (60_000, 1)).save(image)
    else:
        image.symlink_to(image if "itself" in kind else root)
    with pytest.raises(InputError, match=r"cannot be (read|used)"):
        open_scene(root, SceneOptions(24, 32)).views([0])
