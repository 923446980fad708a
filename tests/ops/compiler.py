"""Triton's compiler, for GPUs that are not at hand."""

import torch

TYPES = {torch.bfloat16: "bf16", torch.float32: "fp32", torch.int64: "i64"}


def compiled(kernel, arguments, architecture):
    """The kernel for these arguments, constants and options of a launch, all by name."""
    from triton import compile
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    signature, constants = {}, {}
    for parameter in kernel.params:
        name, value = parameter.name, arguments.pop(parameter.name)
        if parameter.is_constexpr:
            signature[name], constants[name] = "constexpr", value
        else:
            is_array = isinstance(value, torch.Tensor)
            signature[name] = "*" + TYPES[value.dtype] if is_array else "i32"
    source = ASTSource(kernel, signature, constants)
    options = arguments
    return compile(source, GPUTarget("cuda", architecture, 32), options)
