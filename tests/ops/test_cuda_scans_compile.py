"""The scans' kernels compile for GPUs that are not at hand: what the interpreter takes, the
compiler may not."""

from importlib import import_module

import pytest
import torch

from asysplat.ops import selective_scan, ssd

triton = pytest.importorskip("triton")

pytestmark = pytest.mark.slow

TYPES = {torch.bfloat16: "bf16", torch.float32: "fp32"}
SCANS = {"ssd": ssd, "selective_scan": selective_scan}
KERNELS = {
    "ssd": {
        *("sum_decays", "pass_on", "multiply_vectors", "output_chunk", "head_gradients"),
        *("score_gradients", "vector_gradients"),
    },
    "selective_scan": {"add_up", "pass_on", "scan_chunk", "scan_chunk_backward"},
}


def compiled(kernel, arguments, constants, architecture):
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    names = kernel.arg_names
    options = {name: constants.pop(name) for name in list(constants) if name not in names}
    signature = {
        name: "*" + TYPES[value.dtype] if isinstance(value, torch.Tensor) else "i32"
        for name, value in zip(names, arguments, strict=False)
    }
    signature |= dict.fromkeys(constants, "constexpr")
    source = ASTSource(kernel, {name: signature[name] for name in names}, constants)
    return triton.compile(source, GPUTarget("cuda", architecture, 32), options)


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize(
    "architecture, dtype",
    [(80, torch.float32), (90, torch.bfloat16)],
    ids=["sm_80-fp32", "sm_90-bf16"],
)
def test_all_kernels_compile(monkeypatch, name, architecture, dtype):
    from triton.runtime.jit import JITFunction

    stages = import_module("asysplat.ops.selective_scan.cuda.stages")
    kernels = {}

    def run(kernel, *arguments, grid, warmup, **constants):
        name = kernel.fn.__name__
        variant = (name, constants.get("GRADIENT", constants.get("OF_B")))
        if variant not in kernels:
            kernels[variant] = compiled(kernel, arguments, constants, architecture)

    monkeypatch.setattr(JITFunction, "run", run)
    monkeypatch.setattr("asysplat.ops.dispatch._interpreted", lambda backend: True)
    # As few unrolled tokens as show all: the compiler takes seconds for each.
    monkeypatch.setattr(stages, "FORWARD_CHUNK", 2)
    monkeypatch.setattr(stages, "BACKWARD_CHUNK", 2)
    heads, state = ((2, 16), 128) if name == "ssd" else ((2,), 16)
    x = torch.zeros(1, 70, *heads, dtype=dtype, requires_grad=True)
    vectors = torch.zeros(1, 70, state, dtype=dtype)
    rates = torch.zeros(2) if name == "ssd" else torch.zeros(2, state)
    y = SCANS[name](
        x, torch.zeros(1, 70, 2), rates, vectors, vectors, torch.zeros(2), backend="cuda"
    )
    y.sum().backward()
    assert {kernel for kernel, _ in kernels} == KERNELS[name]
    assert all(kernel.asm["cubin"] for kernel in kernels.values())
