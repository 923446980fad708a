"""What every test gets: a seed, small scenes, the scripts, the shared data if it is there, and no
GPU test without a GPU."""

import io
import os
import runpy
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from copy import deepcopy
from functools import cache
from pathlib import Path
from unittest import mock

import pytest
import torch
from compiler import INTERPRETED
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from asysplat.scene import Cameras, Gaussians

if INTERPRETED:
    import interpreter  # noqa: F401

REPO = Path(__file__).resolve().parents[1]
BUDGET = 600  # seconds of make test alone on two cores
SHARE = 0.1  # of the budget, above which a file is named
STARTED = time.monotonic()
pytest_plugins = ["tiny_runs"]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of shared photographs and weights; a test that asks for it is skipped without."""
    folder = Path(os.environ.get("ASYSPLAT_SHARED", REPO.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent: set ASYSPLAT_SHARED")
    return folder


@pytest.fixture(scope="session")
def repository() -> Path:
    return REPO


@pytest.fixture(scope="session")
def composed():
    """The configuration of a script, train.py unless named, with these overrides."""

    def config(*overrides: str, script: str = "train", **options):
        # A copy, which takes a twentieth of the time of composing.
        return deepcopy(compose_once(script, overrides, *options.items()))

    return config


@cache
def compose_once(script: str, overrides: tuple[str, ...], *options: tuple[str, object]):
    with initialize_config_dir(str(REPO / "conf"), version_base=None):
        return compose(script, list(overrides), **dict(options))


@pytest.fixture(scope="session")
def build():
    """The network that `train.py` would build for these overrides."""
    return build_network


def build_network(*overrides: str, device: str = "cpu") -> torch.nn.Module:
    model = compose_once("train", overrides).model
    return (
        on_meta(OmegaConf.to_yaml(model, resolve=True)) if device == "meta" else instantiate(model)
    )


@cache
def on_meta(model: str) -> torch.nn.Module:
    with torch.device("meta"):
        return instantiate(OmegaConf.create(model))


@pytest.fixture(scope="session")
def run_script():
    return _run_script


def _run_script(name: str, *overrides: str) -> subprocess.CompletedProcess:
    """Run a script as its own interpreter would, in this process."""
    script, out, err, status = REPO / name, io.StringIO(), io.StringIO(), None

    def show(message, category, filename, lineno, file=None, line=None):
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))

    deterministic = torch.get_deterministic_debug_mode()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD)
    handlers = {number: signal.getsignal(number) for number in numbers}
    with (
        pytest.MonkeyPatch.context() as patch,
        mock.patch.dict(os.environ),
        warnings.catch_warnings(),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        warnings.resetwarnings()
        warnings.filterwarnings("ignore", module="beartype")  # of types, when it first reads them
        patch.setattr(warnings, "formatwarning", warnings.formatwarning)
        patch.setattr(warnings, "showwarning", show)
        patch.setattr(sys, "unraisablehook", sys.unraisablehook)
        patch.setattr(sys, "argv", [str(script), *map(str, overrides)])
        patch.chdir(REPO)
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as end:
            status = end.code
    torch.set_deterministic_debug_mode(deterministic)
    for number, handler in handlers.items():
        signal.signal(number, handler)
    if isinstance(status, str):
        print(status, file=err)
    code = status if isinstance(status, int) else int(status is not None)
    return subprocess.CompletedProcess([name, *overrides], code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def make_scene():
    return _make_scene


def _make_scene(count=12, views=1, height=13, width=17, degree=1, dtype=torch.float64, seed=0):
    """Gaussians of about 2 pixels in front of cameras that are a little turned and moved."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    depths = torch.linspace(2, 5, count, dtype=torch.float64)[:, None]
    means = torch.cat((0.3 * normal(count, 2) * depths, depths), -1)
    gaussians = Gaussians(
        means=means,
        quats=normal(count, 4),
        scales=0.12 * depths * (0.4 * normal(count, 3)).exp(),
        opacities=torch.rand(count, generator=generator, dtype=torch.float64) * 0.4 + 0.3,
        sh=0.3 * normal(count, (degree + 1) ** 2, 3),
    )
    rotations = torch.linalg.matrix_exp(0.05 * (lambda m: m - m.mT)(normal(views, 3, 3)))
    cam_to_world = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    cam_to_world[:, :3, :3] = rotations
    cam_to_world[:, :3, 3] = 0.1 * normal(views, 3)
    intrinsics = torch.tensor(
        [[width, 0, 0.45 * width], [0, 0.9 * width, 0.55 * height], [0, 0, 1]], dtype=torch.float64
    ).repeat(views, 1, 1)
    cameras = Cameras(intrinsics, cam_to_world, height, width)
    return gaussians.to(dtype), cameras.to(dtype)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.fixture
def threads():
    """Set the number of threads until the test's end."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.hookimpl(trylast=True)  # of the tests that are left
def pytest_collection_modifyitems(items):
    # Long files first, so that no process is left with one at the end.
    seconds = Counter()
    for item in items:
        seconds[item.path] += 5 if item.get_closest_marker("medium") else 0.1
    items.sort(key=lambda item: -seconds[item.path])
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


def pytest_terminal_summary(terminalreporter):
    """Print the seconds of each folder of tests and, last, those of all beside the budget."""
    seconds: dict[str, Counter] = {"folder": Counter(), "file": Counter()}
    for report in (r for reports in terminalreporter.stats.values() for r in reports):
        file = Path(getattr(report, "nodeid", "").partition("::")[0])
        seconds["file"][file.name] += getattr(report, "duration", 0)
        seconds["folder"][file.parent.name] += getattr(report, "duration", 0)
    if (took := time.monotonic() - STARTED) < BUDGET / 10:
        return
    listed = [f"{name} {spent:.0f}" for name, spent in seconds["folder"].most_common()]
    terminalreporter.write_line(f"seconds: {', '.join(listed)}")
    large = [f"{name} {t:.0f} s" for name, t in seconds["file"].items() if t > SHARE * BUDGET]
    line = f"{took:.0f} s of a budget of {BUDGET} s; more than {SHARE:.0%} of it take: "
    terminalreporter.write_line(line + (", ".join(large) or "none"))
