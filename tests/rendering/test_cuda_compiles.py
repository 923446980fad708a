"""The kernels of "cuda" compile for GPUs that are not at hand: what the interpreter takes, the
compiler may not."""

import ast

import pytest
import torch
from compiler import collect_kernels

from asysplat.rendering import render

pytest.importorskip("triton")

pytestmark = pytest.mark.medium

KERNELS = {
    *("project", "list_tiles", "rasterize", "rasterize_backward", "sum_pairs"),
    "project_backward",
}


def keep_one_pair(arguments):
    """Leave every Gaussian with one pair."""
    for name, value in arguments.items():
        if name in ("depths", "counts"):
            value.fill_(1)
        elif isinstance(value, torch.Tensor) and not value.is_floating_point():
            value.fill_(0)


OTHER = {"depth": "median", "antialiased": True, "sh_degree": 0}


@pytest.mark.parametrize(
    "architecture, options",
    [
        (90, {}),
        pytest.param(80, {}, marks=pytest.mark.slow),
        pytest.param(80, OTHER, marks=pytest.mark.slow),
        pytest.param(90, OTHER, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_all_kernels_compile(make_scene, monkeypatch, architecture, options):
    launched = collect_kernels(monkeypatch, architecture, fill=keep_one_pair)
    monkeypatch.setattr("asysplat.rendering.cuda.draw.INTERPRETED", True)
    gaussians, cameras = make_scene(dtype=torch.float32, degree=3)
    cameras.cam_to_world.requires_grad_()
    gaussians.sh.requires_grad_()
    masks = torch.ones(1, cameras.height, cameras.width, dtype=torch.bool)
    out = render(gaussians, cameras, backend="cuda", masks=masks, **options)
    out.image.sum().backward()
    assert {kernel for kernel, *_ in launched} == KERNELS
    assert all(kernel.asm["cubin"] for kernel in launched.values())


def test_kernels_unpack_no_tuple_within_a_tuple(repository):
    """Triton 3.6, which torch 2.11 needs, does not read `(a, b), c = ...`."""
    paths = [*(repository / "asysplat").rglob("cuda/*.py")]
    kernels = [
        node
        for tree in (ast.parse(path.read_text()) for path in paths)
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any(isinstance(name, ast.Name) and name.id == "kernel" for name in node.decorator_list)
    ]
    formulas = ast.parse((repository / "asysplat/rendering/formulas.py").read_text())
    assert kernels
    for node in ast.walk(ast.Module([*kernels, formulas], [])):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            names = node.targets[0].elts
            assert not any(isinstance(name, ast.Tuple) for name in names), ast.unparse(node)
