"""Grid attention: all sizes and values against the formula in float64."""

import inspect

import pytest
import torch
from scans import ERROR, relative_error, sum_error

from asysplat.errors import InputError
from asysplat.ops import grid_attention

HUGE = 1e18
BOUND = ERROR[torch.float32]
per_backend = pytest.mark.parametrize("backend", ["sdpa", "reference"])
per_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)


def make_qkv(batch=2, views=3, height=4, width=6, heads=2, head_dim=8, dtype=torch.float32):
    shape = (batch, views, height, width, heads, head_dim)
    return [tensor.to(dtype) for tensor in torch.randn(3, *shape)]


def by_formula(q, k, v, grid):
    """Compute softmax(q k^T / sqrt(P)) v for one grid place at a time."""
    output = torch.empty_like(v)
    for i in range(min(grid, q.shape[2])):
        for j in range(min(grid, q.shape[3])):
            place = (slice(None), slice(None), slice(i, None, grid), slice(j, None, grid))
            queries, keys, values = (t[place].flatten(1, 3).transpose(1, 2) for t in (q, k, v))
            scores = queries @ keys.mT / q.shape[-1] ** 0.5
            tokens = (scores.softmax(-1) @ values).transpose(1, 2)
            output[place] = tokens.reshape(v[place].shape)
    return output


def both_ways(attention, qkv, grad_output):
    leaves = [tensor.detach().clone().requires_grad_() for tensor in qkv]
    output = attention(*leaves)
    return [output.detach(), *torch.autograd.grad(output, leaves, grad_output)]


def exactly(qkv, grad_output, grid=2):
    double = [tensor.double() for tensor in qkv]
    return both_ways(lambda *t: by_formula(*t, grid), double, grad_output.double())


def assert_exact(backend, qkv, grid=2, bound=None):
    grad_output = torch.randn_like(qkv[2])
    results = both_ways(lambda *t: grid_attention(*t, grid, backend=backend), qkv, grad_output)
    exact = exactly(qkv, grad_output, grid)
    for name, value, right in zip("oqkv", results, exact, strict=True):
        assert value.dtype == qkv[0].dtype and value.isfinite().all(), name
        assert relative_error(value, right) <= (bound or ERROR[value.dtype]), name


SHAPES = [(1, 1, 6, 12), (3, 2, 6, 12), (2, 3, 1, 1), (2, 3, 1, 5), (2, 3, 5, 7)]
SIZES = [(*shape, 2, 8, grid) for shape in SHAPES for grid in (1, 2, 3)]
SIZES += [(2, 3, 4, 6, *width, 2) for width in ((1, 1), (1, 64), (5, 3))]


@per_backend
@per_dtype
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_every_size_is_exact(backend, dtype, size):
    """Padding has no effect, not even where a grid place has no token."""
    assert_exact(backend, make_qkv(*size[:-1], dtype=dtype), grid=size[-1])


@per_backend
@per_dtype
@pytest.mark.parametrize("factor", [0, 1e-18, HUGE])
def test_values_of_every_size(backend, dtype, factor):
    q, k, v = make_qkv(dtype=dtype)
    assert_exact(backend, (q, k, v * factor))


@per_backend
def test_scores_of_every_size(backend):
    q, k, v = make_qkv()
    assert_exact(backend, (0 * q, k, v))
    assert_exact(backend, (q, k * 1e-18, v))
    # A probability is the exponential of a score, which is rounded in proportion to its size.
    largest = 100 * (q.norm(dim=-1).max() * k.norm(dim=-1).max()) / q.shape[-1] ** 0.5
    assert_exact(backend, (10 * q, 10 * k, v), bound=torch.finfo(torch.float32).eps * largest)
    # The softmax picks one token.
    huge = HUGE * q, HUGE * k, v
    expected = by_formula(*(t.double() for t in huge), 2)
    assert relative_error(grid_attention(*huge, 2, backend), expected) <= BOUND


@per_backend
def test_strided_and_expanded_inputs(backend):
    q, k, v = make_qkv()
    strided = q.permute(5, 4, 3, 2, 1, 0).contiguous().permute(5, 4, 3, 2, 1, 0)
    leaves = [t.clone().requires_grad_() for t in (strided, k[:, :1], v[..., :1])]
    inputs = [leaf.expand_as(q) for leaf in leaves]
    output = grid_attention(*inputs, 2, backend=backend)
    exact, *exact_grads = exactly(inputs, torch.ones_like(q))
    assert relative_error(output, exact) <= BOUND
    grads = torch.autograd.grad(output.sum(), leaves)
    for name, grad, whole in zip("qkv", grads, exact_grads, strict=True):
        assert sum_error(grad, whole) <= BOUND, name


@per_backend
def test_one_input_alone_needs_a_gradient(backend):
    qkv = make_qkv()
    ones = torch.ones_like(qkv[0])
    _, *grads = both_ways(lambda *t: grid_attention(*t, 2, backend=backend), qkv, ones)
    for index, name in enumerate("qkv"):
        inputs = [t.clone().requires_grad_(i == index) for i, t in enumerate(qkv)]
        grid_attention(*inputs, 2, backend=backend).backward(ones)
        assert relative_error(inputs[index].grad, grads[index]) <= BOUND, name


@per_backend
def test_every_gradient_equals_finite_differences(backend):
    qkv = make_qkv(1, 2, 3, 5, 1, 2, torch.float64)
    leaves = [tensor.requires_grad_() for tensor in qkv]
    assert torch.autograd.gradcheck(
        lambda *t: grid_attention(*t, 2, backend=backend), leaves, fast_mode=True
    )


def test_any_number_of_threads_gives_the_same_bits(threads):
    qkv = make_qkv(2, 5, 3, 5)
    runs = []
    for count in (1, 1, 2, 2):
        threads(count)
        runs.append(both_ways(lambda *t: grid_attention(*t, 2), qkv, torch.ones_like(qkv[0])))
        assert all(map(torch.equal, runs[-1], runs[0])), count


@pytest.mark.parametrize("name", range(3), ids="qkv".__getitem__)
def test_tensors_that_do_not_fit_are_named(name):
    wrong = {
        r"has shape \(.*\): expected [([]": lambda t: t[0],
        "is torch.int64: give floating-point numbers": torch.Tensor.long,
    }
    if name:
        wrong[r"has shape \(.*\): expected \("] = lambda t: t[:, :1]
        wrong["is on meta and q on cpu"] = lambda t: t.to("meta")
    for sentence, change in wrong.items():
        qkv = make_qkv()
        qkv[name] = change(qkv[name])
        with pytest.raises(InputError, match=rf"grid_attention's {'qkv'[name]} {sentence}"):
            inspect.unwrap(grid_attention)(*qkv, 2)  # without the tests' type checker
    for grid in (0, -1):
        with pytest.raises(InputError, match=rf"grid={grid}"):
            grid_attention(*make_qkv(), grid)
