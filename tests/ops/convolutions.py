"""The inputs of the convolution under test, both passes, and its errors against float64."""

import torch

from asysplat.ops import conv_silu

KINDS = [(4, 3, True), (4, 0, True), (4, 2, False), (3, 1, False)]  # K, before, and a bias
ERROR = {torch.float32: 1e-6, torch.bfloat16: 1e-2, torch.float16: 1e-3}  # relative, L2


def make_inputs(shape=(2, 9, 6), size=4, bias=True, dtype=torch.float32):
    """Tokens in `dtype`, and weights and a bias in float32."""
    shapes = [shape, (shape[-1], size), *([shape[-1:]] if bias else [])]
    tokens, *parameters = (torch.randn(shape) for shape in shapes)
    return [tokens.to(dtype), *parameters]


def both_ways(inputs, before, grad_output=None, **options):
    """The output, and the gradients of tokens, weight and the bias if there is one."""
    leaves = [tensor.detach().requires_grad_() for tensor in inputs]
    y = conv_silu(*leaves, *[None] * (3 - len(leaves)), before, **options)
    generator = torch.Generator().manual_seed(1)
    if grad_output is None:
        grad_output = torch.randn(y.shape, generator=generator)
    return [y.detach(), *torch.autograd.grad(y, leaves, grad_output.to(y))]


def assert_exact(inputs, before, backend):
    """The results have the inputs' types, and are those of the reference in float64."""
    results = both_ways(inputs, before, backend=backend)
    exact = both_ways([tensor.cpu().double() for tensor in inputs], before, backend="reference")
    for like, result, value in zip([inputs[0], *inputs], results, exact, strict=True):
        assert result.dtype == like.dtype and result.shape == value.shape
        error = (result.cpu().double() - value).norm()
        assert error <= ERROR[inputs[0].dtype] * value.norm()
