"""The depthwise convolution against torch's convolution of sequences."""

import pytest
import torch
import torch.nn.functional as F

from asysplat.models.mamba import depthwise_conv

SIZES = [(4, 3), (4, 0), (3, 1)]  # of the kernel, and before


def inputs(size, dtype=torch.float64, batch=2, length=9, channels=6):
    generator = torch.Generator().manual_seed(0)
    shapes = ((batch, length, channels), (channels, 1, size), (channels,))
    return [
        torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()
        for shape in shapes
    ]


def as_sequences(tokens, weight, bias, before):
    padded = F.pad(tokens.mT, (before, weight.shape[-1] - 1 - before))
    return F.conv1d(padded, weight, bias, groups=len(weight)).mT


@pytest.mark.parametrize("size, before", SIZES)
def test_values_and_gradients_equal_torch(size, before):
    leaves = inputs(size)
    y, expected = depthwise_conv(*leaves, before), as_sequences(*leaves, before)
    torch.testing.assert_close(y, expected, rtol=0, atol=1e-12)
    assert torch.autograd.gradcheck(lambda *leaves: depthwise_conv(*leaves, before), leaves)


def test_tokens_in_half_precision():
    """Under autocast the weights and their gradients stay fp32."""
    leaves = inputs(4, torch.float32, length=200)
    half = [leaves[0].bfloat16().detach().requires_grad_(), *leaves[1:]]
    grad_output = torch.randn(2, 200, 6, generator=torch.Generator().manual_seed(1))
    with torch.autocast("cpu", torch.bfloat16):
        y = depthwise_conv(*half, 3)
    grads = torch.autograd.grad(y, half, grad_output.bfloat16())
    expected = as_sequences(*leaves, 3)
    exact = torch.autograd.grad(expected, leaves, grad_output)
    assert y.dtype == grads[0].dtype == torch.bfloat16 and grads[1].dtype == torch.float32
    for result, value in zip((y, *grads), (expected, *exact), strict=True):
        assert (result.float() - value).norm() <= 1e-2 * value.norm()


def test_a_backward_pass_under_autocast_has_the_same_bits():
    leaves = inputs(4, torch.float32)
    grad_output = torch.randn(2, 9, 6, generator=torch.Generator().manual_seed(1))
    expected = torch.autograd.grad(depthwise_conv(*leaves, 3), leaves, grad_output)
    with torch.autocast("cpu", torch.bfloat16):
        grads = torch.autograd.grad(depthwise_conv(*leaves, 3), leaves, grad_output)
    assert all(map(torch.equal, grads, expected))


def test_a_convolution_may_have_no_bias():
    tokens, weight, _ = inputs(3)
    expected = as_sequences(tokens, weight, None, 1)
    torch.testing.assert_close(depthwise_conv(tokens, weight, None, 1), expected)
