"""The suite on tiny cases: right kernels, wrong ones, some that do not run, and other libraries."""

import re
import sys
from io import StringIO
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from rich.console import Console

from asysplat.kernels.self_check import TOLERANCE
from asysplat.ops.adam import cpu as adam_kernels
from asysplat.ops.ssd import cpu as ssd_kernels
from benchmarks import device, libraries
from benchmarks.device import CASES, SIZES, measure_operator, tables, verdict
from benchmarks.ops import SCANS
from benchmarks.options import CPU
from benchmarks.timing import Measurement, time_in_rounds

TINY = {
    "render": {"gaussians": 50, "height": 20, "width": 24},
    "render_1M": {"gaussians": 70, "height": 20, "width": 24},
    "ssd": {"batch": 1, "length": 20, "heads": 2, "head_dim": 16, "state": 16},
    "selective_scan": {"batch": 2, "length": 20, "channels": 16, "state": 16},
    "plane_sweep": {"batch": 1, "views": 3, "height": 16, "width": 20, "planes": 8, "neighbors": 2},
    "grid_attention": {"batch": 1, "views": 2, "height": 4, "width": 6}
    | {"heads": 2, "head_dim": 8, "grid": 2},
    "adam": {"gaussians": 50},
    "image_loss": {"images": 2, "height": 12, "width": 16},
}
WITHOUT_GRADIENTS = {"render forward", "plane_sweep", "adam"}
LARGE = {"render_1M"}  # not timed in torch
# The libraries' functions, as their sources declare them, computed by ours.
FAKES = {
    "gsplat.py": """
from asysplat import Cameras, Gaussians, render

def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree):
    assert colors.shape[-2] == (sh_degree + 1) ** 2
    gaussians = Gaussians(means, quats, scales, opacities, colors)
    out = render(gaussians, Cameras(Ks, viewmats.inverse(), height, width), depth=False)
    return out.image.permute(0, 2, 3, 1), out.alpha[..., None], {}
""",
    "mamba_ssm/__init__.py": "",
    "mamba_ssm/ops/__init__.py": "",
    "mamba_ssm/ops/triton/__init__.py": "",
    "mamba_ssm/ops/triton/ssd_combined.py": """
from asysplat.ops import ssd

def mamba_chunk_scan_combined(x, dt, A, B, C, chunk_size, D=None):
    return ssd(x, dt, A, B[:, :, 0], C[:, :, 0], D)
""",
    "mamba_ssm/ops/selective_scan_interface.py": """
from asysplat.ops import selective_scan

def selective_scan_fn(u, delta, A, B, C, D=None):
    return selective_scan(u.mT, delta.mT, A, B.mT, C.mT, D).mT
""",
    "flash_attn.py": """
from torch.nn.functional import scaled_dot_product_attention

def flash_attn_func(q, k, v):
    q, k, v = (tensor.transpose(1, 2) for tensor in (q, k, v))
    return scaled_dot_product_attention(q, k, v).transpose(1, 2)
""",
}
USERS = LARGE | {"render", "render forward", "ssd", "selective_scan", "grid_attention"}

pytestmark = pytest.mark.medium


@pytest.fixture(autouse=True)
def tiny(monkeypatch, request):
    """Measure tiny cases, without the libraries that the machine has."""
    monkeypatch.setitem(SIZES, "cpu", TINY)
    if "install" not in request.fixturenames:
        monkeypatch.setattr(libraries, "find_spec", lambda name: None)


@pytest.fixture
def install(monkeypatch, tmp_path):
    """Install modules until the test ends."""

    def write(files):
        for name, source in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(source)
            monkeypatch.delitem(sys.modules, Path(name).parts[0].removesuffix(".py"), raising=False)

    known = set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)
    yield write
    for name in set(sys.modules) - known:
        if name.partition(".")[0] in libraries.LIBRARIES:
            del sys.modules[name]


def shown(results):
    console = Console(width=80, file=StringIO())
    console.print(*tables({"machine": {"cpu": "some"}, **results}))
    text = console.file.getvalue()
    assert "…" not in text  # nothing is cut off in a narrow terminal
    return " ".join(text.split())  # notes are wrapped


def test_every_operator_is_right_and_timed(run_suite, capsys):
    results = run_suite("device", {})
    lines = capsys.readouterr().out
    assert [row["operator"] for row in results["rows"]] == list(CASES)
    for row in results["rows"]:
        names = {"outputs"} if row["operator"] in WITHOUT_GRADIENTS else {"outputs", "gradients"}
        assert row["error"].keys() == names and row["backend"] == "cpu"
        assert all(0 < error < TOLERANCE for error in row["error"].values())
        assert row["first"] > 0 and row["kernels"]["median"] > 0
        assert (row["torch"] is None) == (row["operator"] in LARGE)
        assert row["fault"] == "" and row["notes"] == [] and row["library"] is None
        assert re.search(rf"^{row['operator']}: kernels \S+ ms", lines, re.M)
    text = shown(results)
    assert verdict(results) is None and "WRONG │" not in text
    for name in ("gsplat", "mamba_ssm", "flash_attn"):
        assert f"{name} not installed" in text


def test_a_flipped_sign_is_wrong_and_kernels_that_do_not_run_have_a_reason(run_suite, monkeypatch):
    constants = adam_kernels._constants

    def flipped(settings):
        right = constants(settings)
        return right._replace(new1=-right.new1)

    def fail(*arguments):
        raise RuntimeError("no such instruction\nin line 3")

    monkeypatch.setattr(adam_kernels, "_constants", flipped)
    monkeypatch.setattr(ssd_kernels, "forward", fail)
    message = (
        r"^wrong: ssd's kernels do not run \(RuntimeError: no such instruction\); adam's kernels "
        r"have a relative error of \S+$"
    )
    with pytest.raises(SystemExit, match=message):
        run_suite("device", {})
    adam, ssd = (measure_operator(name, CPU, repeats=1) for name in ("adam", "ssd"))
    assert adam["error"]["outputs"] > TOLERANCE and adam["kernels"]["median"] > 0
    assert ssd["error"] is ssd["kernels"] is ssd["torch"] is None
    text = shown({"rows": [adam, ssd], "device": "some", "libraries": "none"})
    assert text.count("WRONG │") == 2 and "no such instruction" in text


def test_kernels_that_torch_contradicts_at_the_timed_size_are_wrong(monkeypatch):
    case = CASES["image_loss"]

    def doubled(sizes, device):
        right = case(sizes, device)
        return right._replace(run=lambda backend: right.run(backend) * (1 + (backend == "cpu")))

    monkeypatch.setitem(CASES, "image_loss", doubled)
    row = measure_operator("image_loss", CPU, repeats=1)
    assert row["fault"] == "differ from torch by 100% where timed"
    assert max(row["error"].values()) < TOLERANCE


def test_libraries_are_timed_where_they_are_installed(install):
    install(FAKES)
    rows = {name: measure_operator(name, CPU, repeats=1) for name in CASES}
    for name, row in rows.items():
        assert row["notes"] == [] and row["fault"] == ""
        assert (row["library"] is not None) == (name in USERS)
    text = shown({"rows": list(rows.values()), "device": "some", "libraries": "none"})
    for name in USERS:
        assert f"{1e3 * rows[name]['library']['median']:.2f} " in text
    assert libraries.describe_library("gsplat") == "gsplat of unknown version"


@pytest.mark.parametrize(
    "source, note",
    [
        (
            "raise ImportError('for another torch')",
            r"does not run \(ImportError: for another torch",
        ),
        ("def flash_attn_func(q, k, v): return 0 * (q + k + v)", "'s output differs by (nan|inf)%"),
        ("def flash_attn_func(q, k, v): return 2 * q + 0 * (k + v)", r"'s output differs by \d+%"),
    ],
)
def test_a_library_that_fails_is_a_note(install, source, note):
    install({"flash_attn.py": source})
    row = measure_operator("grid_attention", CPU, repeats=1)
    assert row["library"] is None and row["fault"] == ""
    (found,) = row["notes"]
    assert re.match(f"flash_attn ?{note}", found)
    assert row["kernels"]["median"] > 0 and row["torch"]["median"] > 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_run_goes_on_where_no_kernel_runs(monkeypatch):
    monkeypatch.setitem(SIZES, "cuda", {name: TINY[name] for name in SIZES["cuda"]})
    monkeypatch.setattr(device, "find_device", torch.device)
    monkeypatch.setattr(device, "describe_gpu", lambda device: "a GPU of 1999")
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: True)
    results = device.measure(
        OmegaConf.create({"device": "cuda", "repeats": 1}), Console(quiet=True)
    )
    assert {row["operator"] for row in results["rows"]} == CASES.keys() - {"image_loss"}
    assert all(re.match(r"do not run \(\w+: .", row["fault"]) for row in results["rows"])
    assert [row["operator"] for row in results["rows"] if row["precision"] == "bf16"] == [
        *SCANS,
        "grid_attention",
    ]
    assert "Kernels on a GPU of 1999; gsplat not installed" in shown(results)


def test_no_round_begins_after_the_limit():
    calls = []
    time_in_rounds([Measurement(lambda: calls.append(0) or {"a": 1.0})], 5, seconds=0.0)
    assert len(calls) == 2  # one to warm up
