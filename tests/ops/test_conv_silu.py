"""The convolution of Mamba's blocks: its formula, and the CPU's kernels against it in float64."""

import inspect

import pytest
import torch
import torch.nn.functional as F
from convolutions import ERROR, KINDS, assert_exact, both_ways, make_inputs
from torch.utils.flop_counter import FlopCounterMode

from asysplat.errors import InputError
from asysplat.ops import conv_silu

# Shorter than K, around a band, and of several; around a vector and of several.
SHAPES = [(2, 1, 1), (3, 2, 16), (2, 9, 17), (2, 127, 5), (2, 128, 40), (1, 300, 130)]


@pytest.mark.parametrize("size, before, bias", KINDS)
def test_the_reference_is_torchs_convolution(size, before, bias):
    inputs = [tensor.double() for tensor in make_inputs(size=size, bias=bias)]
    tokens, weight, *rest = inputs
    padded = F.pad(tokens.mT, (before, size - 1 - before))
    expected = F.silu(F.conv1d(padded, weight[:, None], *rest, groups=len(weight)).mT)
    torch.testing.assert_close(both_ways(inputs, before)[0], expected, rtol=0, atol=1e-12)
    leaves = [*(tensor.requires_grad_() for tensor in inputs), *[None] * (not bias)]
    assert torch.autograd.gradcheck(lambda *leaves: conv_silu(*leaves, before), leaves)


@pytest.mark.parametrize("size, before, bias", KINDS)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_kernels_compute_the_reference(shape, size, before, bias):
    assert_exact(make_inputs(shape, size, bias), before, "cpu")


@pytest.mark.parametrize("dtype", ERROR, ids=str)
def test_types_of_tokens(dtype):
    assert_exact(make_inputs((2, 21, 18), dtype=dtype), 3, "cpu")


@pytest.mark.parametrize("width, first", [(37, 5), (48, 16), (40, 0)])
def test_slices_of_channels_are_read_where_they_are(width, first):
    tokens, *parameters = make_inputs((2, 21, width))
    part, parameters = tokens[..., first : first + 20], [p[:20] for p in parameters]
    plain = both_ways([part.contiguous(), *parameters], 3, backend="cpu")
    assert all(map(torch.equal, both_ways([part, *parameters], 3, backend="cpu"), plain))
    # So is the gradient of the output, which may be expanded, too.
    wide = torch.randn(2, 21, width)[..., first : first + 20]
    for grad_output in (wide, torch.randn(2, 20, 21).mT, torch.ones(1, 1, 1).expand(2, 21, 20)):
        given = [
            both_ways([part, *parameters], 3, grad_output=grad, backend="cpu")
            for grad in (grad_output, grad_output.contiguous())
        ]
        assert all(map(torch.equal, *given))


def test_tokens_with_channels_apart():
    tokens, *parameters = make_inputs((2, 21, 20))
    apart = tokens.mT.contiguous().mT
    plain = both_ways([tokens, *parameters], 3, backend="cpu")
    assert all(map(torch.equal, both_ways([apart, *parameters], 3, backend="cpu"), plain))


def test_any_number_of_threads_and_every_run_give_the_same_bits(threads):
    inputs = make_inputs((3, 300, 33))
    threads(1)
    one = both_ways(inputs, 3, backend="cpu")
    for count in (1, 2, 3):
        threads(count)
        assert all(map(torch.equal, both_ways(inputs, 3, backend="cpu"), one))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_autocast_changes_no_bit(dtype):
    """Neither pass; parameters and their gradients stay fp32."""
    inputs = make_inputs((2, 21, 18), dtype=dtype)
    for backend in ("cpu", "reference"):
        expected = both_ways(inputs, 3, backend=backend)
        with torch.autocast("cpu", torch.bfloat16):
            assert all(map(torch.equal, both_ways(inputs, 3, backend=backend), expected))


def test_large_numbers_have_finite_gradients():
    tokens, weight, bias = make_inputs((1, 21, 18))
    results = both_ways([1e4 * tokens, weight, bias], 3, backend="cpu")
    assert all(result.isfinite().all() for result in results)
    assert_exact([1e4 * tokens, weight, bias], 3, "cpu")


def test_it_saves_nothing_but_its_inputs():
    leaves = [tensor.requires_grad_() for tensor in make_inputs()]
    saved = []
    with torch.autograd.graph.saved_tensors_hooks(saved.append, lambda tensor: tensor):
        conv_silu(*leaves, 3, backend="cpu")
    inputs = {leaf.data_ptr() for leaf in leaves}
    assert {tensor.data_ptr() for tensor in saved} == inputs


def test_flops_are_those_of_a_convolution_on_the_meta_device():
    leaves = [tensor.to("meta").requires_grad_() for tensor in make_inputs((2, 21, 18))]
    with FlopCounterMode(display=False) as counter:
        y = conv_silu(*leaves, 3)
        assert y.shape == leaves[0].shape
        assert counter.get_total_flops() == 2 * y.numel() * 4
        grads = torch.autograd.grad(y.sum(), leaves)
    assert [grad.shape for grad in grads] == [leaf.shape for leaf in leaves]
    assert counter.get_total_flops() == 4 * 2 * y.numel() * 4


def test_torch_knows_the_operator():
    tokens, weight, bias = (tensor.requires_grad_() for tensor in make_inputs((2, 9, 18)))
    for arguments in ((tokens, weight, bias, 3), (tokens[..., :12], weight[:12], None, 0)):
        torch.library.opcheck(torch.ops.asysplat.conv_silu.default, ("cpu", *arguments))


def test_mistakes_are_named():
    tokens, weight, bias = make_inputs()
    wrong = {
        r"tokens has shape \(9, 6\): expected \[B, L, C\]": (tokens[0], weight, bias, 3),
        r"tokens has shape \(2, 0, 6\): every side": (tokens[:, :0], weight, bias, 3),
        r"weight has shape \(6, 1, 4\): expected \[C, K\]": (tokens, weight[:, None], bias, 3),
        r"weight has shape \(5, 4\): expected \(6, 4\)": (tokens, weight[:5], bias, 3),
        r"bias has shape \(5,\): expected \(6,\)": (tokens, weight, bias[:5], 3),
        "bias is on meta and tokens on cpu": (tokens, weight, bias.to("meta"), 3),
        "tokens is torch.int64: give floating": (tokens.long(), weight, bias, 3),
        "before=4: give a number from 0 to 3": (tokens, weight, bias, 4),
    }
    for sentence, arguments in wrong.items():
        with pytest.raises(InputError, match=sentence):
            inspect.unwrap(conv_silu)(*arguments)  # without the tests' type checker
    with pytest.raises(InputError, match="backend='gpu': expected one of auto, reference, cpu"):
        conv_silu(tokens, weight, bias, 3, backend="gpu")
    with pytest.raises(InputError, match="computes in float32"):
        conv_silu(tokens.double(), weight, bias, 3, backend="cpu")
