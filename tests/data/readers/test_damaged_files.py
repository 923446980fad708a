"""Mutants of every file that is read: a sentence or numbers that can be used, and at once.

pytest tests/data/readers -m slow -k damaged -s reads 24,000 and prints what became of them.
"""

import json
import os
import random
import re
import shutil
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hydra.utils import instantiate
from layouts import colmap
from omegaconf import OmegaConf
from PIL import Image
from test_colmap import as_binary
from test_layouts import NAMES
from torch import Tensor, nn

from asysplat import load, read_gaussians, write_gaussians
from asysplat.data import SceneOptions, open_scene
from asysplat.data.images import load_image
from asysplat.errors import InputError
from asysplat.export.gaussians import Notes
from asysplat.scene import Gaussians, Views

OLD_RUN = Path(__file__).parents[2] / "runs" / "old_run"
BINARY = "colmap, binary"
SECONDS = 5.0  # that a mutant may take in addition to what the whole file takes
FEW = 24  # mutants of each kind in the fast test
MANY = 1500
NUMBER = re.compile(rb"-?\d+\.?\d*(?:e[-+]?\d+)?")
NUMBERS = (b"nan", b"-inf", b"1e999", b"1e300", b"-1", b"0", b"9" * 5000, b"1e-320", b"2147483648")
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
    """Change, insert, repeat or cut bytes, or replace a number that is written in digits."""
    start = numbers.randrange(len(stored) + 1)
    if numbers.random() < 0.3:  # where headers are
        start = numbers.randrange(min(len(stored), 200) + 1)
    end = min(len(stored), start + numbers.choice((0, 1, 2, 8, 100)))
    way = numbers.randrange(5)
    if way == 0:
        return stored[:start]
    if way == 1:
        return stored[:start] + numbers.choice(BYTES) + stored[end:]
    if way == 2:
        return stored[:start] + numbers.randbytes(end - start) + stored[end:]
    if way == 3 and (number := NUMBER.search(stored, start)):
        return stored[: number.start()] + numbers.choice(NUMBERS) + stored[number.end() :]
    return stored[:end] + stored[start:]


def hostile_values(folder: Path) -> tuple[object, ...]:
    """What has no place in a run's configuration: aliases, other classes, a user's folder."""
    bomb: list = [1, 2]
    for _ in range(40):
        bomb = [bomb, bomb]
    endless: list = [1]
    endless.append(endless)
    cache = {"_target_": "asysplat.data.ImageCache", "folder": str(folder), "disk_gb": 0}
    vgg16 = {"_target_": "asysplat.training.losses.perceptual.vgg16", "download": True}
    remove = {"_target_": "shutil.rmtree", "_args_": [str(folder)]}
    numbers = (float("nan"), float("inf"), 0, -1, 10**30, 1e300, True, None, "", [], {})
    return bomb, endless, cache, vgg16, remove, str(folder), "${oc.env:HOME}", *numbers


def mutate_yaml(stored: bytes, numbers: random.Random, values: Sequence[object]) -> bytes:
    """Change bytes, or one of the values."""
    if numbers.random() < 0.5:
        return mutate(stored, numbers)
    content = yaml.safe_load(stored)
    places = [(content, key) for key in content]
    for parent, key in places:  # grows as it goes
        value = parent[key]
        if isinstance(value, dict | list):
            keys = value if isinstance(value, dict) else range(len(value))
            places += [(value, inner) for inner in keys]
    parent, key = numbers.choice(places)
    parent[key] = numbers.choice(values)
    return yaml.safe_dump(content).encode()


Result = Views | Gaussians | Tensor


class Attack:
    """Mutants that are read, in a folder beside another that must stay as it is."""

    def __init__(self, outside: Path) -> None:
        self.outside, self.counts = outside, Counter()
        (outside / "folder").mkdir()
        (outside / "notes.txt").write_text("mine")
        np.save(outside / "folder" / "mine.npy", np.zeros(3))
        self.mine = self._contents()

    def __call__(
        self,
        file: Path,
        read: Callable[[], Result],
        count: int,
        seed: str,
        change: Callable[[bytes, random.Random], bytes] = mutate,
    ) -> str:
        """Read mutants of a file, and other things in its place; return what went wrong."""
        stored, numbers, wrong = file.read_bytes(), random.Random(seed), []
        others = self._others(file)
        started = time.monotonic()
        assert not unusable(read())
        self.limit = time.monotonic() - started + SECONDS
        for index in range(count + len(others)):
            remove(file)
            if index < count:
                file.write_bytes(change(stored, numbers))
            else:
                others[index - count](file)
            wrong += [f"{file.name} {index}: {what}" for what in self._read(read)]
        remove(file)
        file.write_bytes(stored)
        return "\n".join(wrong)

    def summary(self) -> str:
        """Return the counts in a line."""
        counts = self.counts
        return (
            f"{counts['read'] + counts['refused'] + counts['traces']:,} mutants: "
            f"{counts['read']:,} read, {counts['refused']:,} refused in a sentence, "
            f"{counts['traces']} traces, {counts['slow']} over {SECONDS:g} s, "
            f"{counts['outside']} written outside, {counts['not usable']} not usable"
        )

    def _read(self, read: Callable[[], Result]) -> list[str]:
        started, wrong = time.monotonic(), {}
        try:
            result = read()
            self.counts["read"] += 1
            wrong |= unusable(result)
        except InputError:
            self.counts["refused"] += 1
        except Exception as error:
            trace = traceback.extract_tb(error.__traceback__)[-1]
            wrong["traces"] = f"{error!r:.200} at {trace.filename}:{trace.lineno}"
        if time.monotonic() - started > self.limit:
            wrong["slow"] = f"{time.monotonic() - started:.1f} s"
        if self._contents() != self.mine:
            wrong["outside"] = "the other folder has changed"
        self.counts.update(wrong.keys())
        return [*wrong.values()]

    def _others(self, file: Path) -> list[Callable[[Path], object]]:
        """Return what makes a pipe, a device, a link, a folder or a file without data."""
        targets = "/dev/zero", self.outside / "notes.txt", self.outside / "folder", "missing"
        links = [lambda path, target=target: path.symlink_to(target) for target in targets]
        # Where every 32 bytes are a Gaussian, they are no damage.
        sizes = [] if file.suffix == ".splat" else [sparse]
        return [os.mkfifo, *links, Path.mkdir, *sizes]

    def _contents(self) -> dict[Path, bytes | None]:
        paths = sorted(self.outside.rglob("*"))
        return {path: path.read_bytes() if path.is_file() else None for path in paths}


def unusable(result: Result) -> dict[str, str]:
    """Return what is wrong with numbers that were read."""
    if isinstance(result, Tensor):
        return {} if result.isfinite().all() else {"not usable": "numbers that are not finite"}
    try:
        result.validate()
    except InputError as error:
        return {"not usable": str(error)}
    return {}


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink()


def sparse(path: Path) -> None:
    """Make a file of 6 GB that takes no room."""
    path.touch()
    os.truncate(path, 6 * 10**9)


@pytest.fixture(scope="module")
def attack(tmp_path_factory):
    attack = Attack(tmp_path_factory.mktemp("outside"))
    yield attack
    print(f"\n{attack.summary()}")


def attack_scene(attack: Attack, layout: str, views, folder: Path, count: int) -> str:
    """Read mutants of each file of a scene, one image of each kind."""
    if layout == BINARY:
        root = as_binary(colmap.write(views, folder))
    else:
        root = import_module(f"layouts.{layout}").write(views, folder)

    def read() -> Views:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sequence = open_scene(root, SceneOptions(24, 32))
            found, points = sequence.views(range(2)), sequence.points
        assert points is None or torch.as_tensor(points).isfinite().all()
        return found

    paths = sorted(path for path in Path(folder).rglob("*") if path.is_file())
    images = {path.suffix: path for path in paths if path.suffix in (".png", ".jpg")}
    files = [path for path in paths if path.suffix not in images] + [*images.values()]
    share = max(1, count // len(files))
    return "\n".join(attack(file, read, share, f"{layout}{file.name}") for file in files).strip()


many_mutants = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])


@many_mutants
@pytest.mark.parametrize("layout", [*NAMES, BINARY])
def test_damaged_scenes_are_refused_or_usable(attack, layout, few, tmp_path, count):
    assert attack_scene(attack, layout, few, tmp_path / "scene", count) == ""


@many_mutants
@pytest.mark.parametrize("suffix", [".ply", ".splat", ".safetensors"])
def test_damaged_gaussians_are_refused_or_usable(attack, suffix, make_scene, tmp_path, count):
    file = tmp_path / f"scene{suffix}"
    if suffix == ".splat":
        file.write_bytes(random.Random(0).randbytes(32 * 20))
    else:
        scene, _ = make_scene(count=20, degree=1, dtype=torch.float32)
        write_gaussians(file, scene, Notes((1e6, 2.0, 3.0), (0.25, 0.5, 0.75)))
    assert attack(file, lambda: read_gaussians(file, (0.0, 0.0, 0.0)), count, suffix) == ""


@many_mutants
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_damaged_images_are_refused_or_usable(attack, suffix, tmp_path, count):
    file = tmp_path / f"image{suffix}"
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(file)
    assert attack(file, lambda: torch.tensor(load_image(file)), count, suffix) == ""


@pytest.mark.medium
@many_mutants
def test_damaged_runs_are_refused_or_usable(attack, composed, few, tmp_path, count):
    """Mutants of the checkpoint and the configuration of a run, which is loaded and called."""
    sizes = ["model=asysplat_4m4s", "model.layers=1m1s", "width=0.0625", "state_size=4"]
    model = OmegaConf.to_container(composed(*sizes).model, resolve=True)
    checkpoint, config = tmp_path / "checkpoints/last.ckpt", tmp_path / "config.yaml"
    checkpoint.parent.mkdir()
    OmegaConf.save({"model": model}, config)
    weights = nn.ModuleDict({"net": instantiate(model)}).state_dict()
    torch.save({"state_dict": weights}, checkpoint)
    views, values = few.resized(32, 32), hostile_values(attack.outside / "folder")

    def read() -> Gaussians:
        with torch.inference_mode():
            return load(str(checkpoint))(views)

    assert attack(checkpoint, read, count // 2, "checkpoint") == ""
    change = partial(mutate_yaml, values=values)
    wrong = attack(config, read, count // 2, "config", change)
    assert wrong == ""  # alone: pytest would write out all values


@pytest.mark.medium
@pytest.mark.timeout(1500)
@many_mutants
def test_damaged_configurations_are_refused_or_measured(attack, run_script, tmp_path, count):
    """Mutants of all of a run's configuration, data and metrics too, which is evaluated."""
    run = shutil.copytree(OLD_RUN, tmp_path / "run")
    results, options = run / "evaluation.json", ["post_optimization_steps=[0]"]

    def read() -> Tensor:
        result = run_script("evaluate.py", f"run={run}", f"paths.logs={tmp_path}", *options)
        if result.returncode == 0:
            numbers = json.loads(results.read_text()).values()
            return torch.tensor([x for x in numbers if isinstance(x, float)])
        assert result.stderr.splitlines()[-1].startswith("error: "), result.stderr
        raise InputError(result.stderr)

    change = partial(mutate_yaml, values=hostile_values(attack.outside / "folder"))
    wrong = attack(run / "config.yaml", read, count // 4, "evaluated", change)
    assert wrong == ""


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
