"""The Triton kernels of the convolution against the reference in float64: on a GPU, or in Triton's
interpreter."""

import pytest
import torch
from compiler import DEVICE, kernel
from convolutions import KINDS, assert_exact, both_ways, make_inputs

# Shorter than K, around the bands of both passes, and around a block of channels.
SHAPES = [(2, 2, 5), (1, 4, 128), (2, 9, 130)]


def on_device(*args, **options):
    return [tensor.to(DEVICE) for tensor in make_inputs(*args, **options)]


@kernel
@pytest.mark.parametrize("size, before, bias", KINDS)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_output_and_gradients_equal_the_reference(shape, size, before, bias):
    assert_exact(on_device(shape, size, bias), before, "cuda")


@kernel
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
def test_half_precision_agrees_with_the_reference(dtype):
    assert_exact(on_device((2, 9, 17), dtype=dtype), 3, "cuda")


@kernel
@pytest.mark.parametrize("width, first", [(37, 5), (48, 16)])
def test_slices_of_channels_are_read_where_they_are(width, first):
    tokens, *parameters = on_device((2, 9, width))
    part, parameters = tokens[..., first : first + 20], [p[:20] for p in parameters]
    grad_output = torch.randn(2, 9, width, device=DEVICE)[..., first : first + 20]
    given, plain = (
        both_ways([tokens, *parameters], 3, grad_output=grad, backend="cuda")
        for tokens, grad in ((part, grad_output), (part.contiguous(), grad_output.contiguous()))
    )
    assert all(map(torch.equal, given, plain))
    apart = part.mT.contiguous().mT, grad_output.mT.contiguous().mT
    given = both_ways([apart[0], *parameters], 3, grad_output=apart[1], backend="cuda")
    assert all(map(torch.equal, given, plain))


@kernel
def test_every_run_gives_the_same_bits_within_autocast_too():
    inputs = on_device((2, 9, 17))
    first = both_ways(inputs, 3, backend="cuda")
    with torch.autocast(DEVICE, torch.bfloat16):
        assert all(map(torch.equal, both_ways(inputs, 3, backend="cuda"), first))


@pytest.mark.gpu
def test_long_sequences_equal_the_reference_and_repeat():
    inputs = on_device((2, 10_007, 650), dtype=torch.bfloat16)
    assert_exact(inputs, 3, "cuda")
    first, again = (both_ways(inputs, 3, backend="cuda") for _ in range(2))
    assert all(map(torch.equal, first, again))
