"""Triton without a GPU: its compiler for other machines, and its interpreter."""

import os

import pytest
import torch

# Triton reads TRITON_INTERPRET when it is first imported: tests of "cuda" run a second time in a
# process that has it set, on a CPU.
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cpu" if INTERPRETED else "cuda"

TYPES = {torch.bfloat16: "bf16", torch.float32: "fp32", torch.float64: "fp64"}
TYPES |= {
    torch.int8: "i8",
    torch.int16: "i16",
    torch.int32: "i32",
    torch.int64: "i64",
    torch.bool: "i1",
}


def compiled(kernel, arguments, architecture):
    """Compile a kernel for the arguments, constants and options of a launch, all by name."""
    from triton import compile
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    signature, constants = {}, {}
    for parameter in kernel.params:
        name, value = parameter.name, arguments.pop(parameter.name)
        if parameter.is_constexpr or value is None:
            signature[name], constants[name] = "constexpr", value
        elif isinstance(value, torch.Tensor):
            signature[name] = "*" + TYPES[value.dtype]
        else:
            signature[name] = "fp32" if isinstance(value, float) else "i32"
    source = ASTSource(kernel, signature, constants)
    options = arguments
    return compile(source, GPUTarget("cuda", architecture, 32), options)


def collect_kernels(monkeypatch, architecture, variant=(), fill=lambda arguments: None):
    """Compile each kernel at its launch instead of running it.

    Args:
        variant: the constants that distinguish variants of a kernel.
        fill: called with the arguments of each launch, to write results.

    Returns:
        The compiled kernels by name and variant, filled by later launches.
    """
    from triton.runtime.jit import JITFunction

    kernels = {}

    def run(kernel, *arguments, grid, warmup, **others):
        arguments = dict(zip(kernel.arg_names, arguments, strict=False)) | others
        name = kernel.fn.__name__, *(arguments.get(constant) for constant in variant)
        if name not in kernels:
            kernels[name] = compiled(kernel, dict(arguments), architecture)
        fill(arguments)

    monkeypatch.setattr(JITFunction, "run", run)
    return kernels


def kernel(test):
    """Run a test where there is a device for kernels."""
    return test if INTERPRETED else pytest.mark.gpu(test)
