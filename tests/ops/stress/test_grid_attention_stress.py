"""Grid attention: all sizes and values against the formula in float64."""

import inspect

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import ERROR, relative_error, sum_error

from asysplat.errors import InputError
from asysplat.ops import grid_attention

BACKENDS = ("sdpa", "reference")
HUGE = 1e18
few = settings(max_examples=5, derandomize=True, deadline=None)
per_backend = pytest.mark.parametrize("backend", BACKENDS)
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


def by_backend(backend, qkv, grad_output, grid=2):
    return both_ways(lambda *t: grid_attention(*t, grid, backend=backend), qkv, grad_output)


def by_formula_in_double(qkv, grad_output, grid=2):
    double = [tensor.double() for tensor in qkv]
    return both_ways(lambda *t: by_formula(*t, grid), double, grad_output.double())


def assert_exact(backend, qkv, grid):
    grad_output = torch.randn_like(qkv[2])
    results = by_backend(backend, qkv, grad_output, grid)
    exact = by_formula_in_double(qkv, grad_output, grid)
    for name, value, right in zip("oqkv", results, exact, strict=True):
        assert value.dtype == qkv[0].dtype, name
        assert value.isfinite().all(), name
        assert relative_error(value, right) <= ERROR[value.dtype], name


@per_backend
@per_dtype
@pytest.mark.parametrize("grid", [1, 2, 3])
@pytest.mark.parametrize("batch, views", [(1, 1), (3, 2)])
def test_every_grid(backend, dtype, grid, batch, views):
    assert_exact(backend, make_qkv(batch, views, 6, 12, dtype=dtype), grid)


@per_backend
@per_dtype
@pytest.mark.parametrize("height, width", [(1, 1), (1, 5), (3, 6), (5, 7), (7, 2)])
@pytest.mark.parametrize("grid", [2, 3])
def test_maps_that_the_grid_does_not_divide(backend, dtype, height, width, grid):
    """Padding has no effect, not even where a grid place has no token."""
    assert_exact(backend, make_qkv(2, 3, height, width, dtype=dtype), grid)


@per_backend
@pytest.mark.parametrize("heads, head_dim", [(1, 1), (1, 64), (5, 3)])
def test_every_width(backend, heads, head_dim):
    assert_exact(backend, make_qkv(heads=heads, head_dim=head_dim), 2)


@per_backend
@per_dtype
@pytest.mark.parametrize("factor", [0, 1e-18, 3, HUGE])
def test_values_of_every_size(backend, dtype, factor):
    q, k, v = make_qkv(dtype=dtype)
    assert_exact(backend, (q, k, v * factor), 2)


@per_backend
@pytest.mark.parametrize("factor", [0, 1e-18])
def test_tiny_queries_and_keys(backend, factor):
    q, k, v = make_qkv()
    assert_exact(backend, (q * factor, k, v), 2)
    assert_exact(backend, (q, k * factor, v), 2)


@per_backend
def test_large_scores(backend):
    """A probability is the exponential of a score, which is rounded in proportion to its size."""
    q, k, v = make_qkv()
    q, k = 10 * q, 10 * k
    grad_output = torch.randn_like(v)
    results = by_backend(backend, (q, k, v), grad_output)
    exact = by_formula_in_double((q, k, v), grad_output)
    largest = (q.norm(dim=-1).max() * k.norm(dim=-1).max()) / q.shape[-1] ** 0.5
    for name, value, right in zip("oqkv", results, exact, strict=True):
        error = relative_error(value, right)
        assert error <= torch.finfo(torch.float32).eps * largest, name


@per_backend
def test_huge_scores(backend):
    """The softmax picks one token."""
    q, k, v = make_qkv()
    q, k = HUGE * q, HUGE * k
    output = grid_attention(q, k, v, 2, backend)
    expected = by_formula(q.double(), k.double(), v.double(), 2)
    assert relative_error(output, expected) <= ERROR[torch.float32]


@per_backend
def test_constants(backend):
    """Each token gets the mean of the others; a common shift of all scores has gradient 0."""
    ones = [torch.ones_like(t) for t in make_qkv()]
    grad_output = torch.ones_like(ones[0])
    results = by_backend(backend, ones, grad_output)
    for value, right in zip(results, (1, 0, 0, 1), strict=True):
        assert (value - right).abs().max() <= ERROR[torch.float32]


@per_backend
def test_strided_and_expanded_inputs(backend):
    q, k, v = make_qkv()
    strided = q.permute(5, 4, 3, 2, 1, 0).contiguous().permute(5, 4, 3, 2, 1, 0)
    inputs = [strided, k[:, :1].expand_as(k), v[..., :1].expand_as(v)]
    expected = by_formula(*(t.double() for t in inputs), 2)
    leaves = [t.requires_grad_() for t in (strided.detach(), k[:, :1].clone(), v[..., :1].clone())]
    output = grid_attention(
        leaves[0], leaves[1].expand_as(k), leaves[2].expand_as(v), 2, backend=backend
    )
    assert relative_error(output, expected) <= ERROR[torch.float32]
    exact = both_ways(lambda *t: by_formula(*t, 2), [t.double() for t in inputs], 1 + 0 * expected)
    grads = torch.autograd.grad(output.sum(), leaves)
    for name, grad, whole in zip("qkv", grads, exact[1:], strict=True):
        assert sum_error(grad, whole) <= ERROR[torch.float32], name


@per_backend
@pytest.mark.parametrize("name", range(3), ids="qkv".__getitem__)
def test_one_input_alone_needs_a_gradient(backend, name):
    qkv = make_qkv()
    grad_output = torch.ones_like(qkv[0])
    grads = by_backend(backend, qkv, grad_output)[1:]
    leaf = qkv[name].requires_grad_()
    grid_attention(*qkv, 2, backend=backend).backward(grad_output)
    assert relative_error(leaf.grad, grads[name]) <= ERROR[torch.float32]


@per_backend
@pytest.mark.parametrize("height, width", [(2, 4), (3, 5)])
def test_every_gradient_equals_finite_differences(backend, height, width):
    qkv = make_qkv(1, 2, height, width, 1, 2, torch.float64)
    leaves = [tensor.requires_grad_() for tensor in qkv]
    assert torch.autograd.gradcheck(
        lambda *t: grid_attention(*t, 2, backend=backend), leaves, fast_mode=True
    )


@pytest.mark.parametrize("height, width", [(4, 6), (3, 5)])
def test_any_number_of_threads_gives_the_same_bits(threads, height, width):
    qkv = make_qkv(2, 5, height, width)

    def run(count):
        threads(count)
        return both_ways(lambda *t: grid_attention(*t, 2), qkv, torch.ones_like(qkv[0]))

    one = run(1)
    for again in (run(1), run(2), run(2)):
        assert all(torch.equal(a, b) for a, b in zip(again, one, strict=True))


@per_backend
@few
@given(a=st.floats(-3, 3), b=st.floats(-3, 3), seed=st.integers(0, 10**6))
def test_linearity_in_the_values(backend, a, b, seed):
    torch.manual_seed(seed)
    (q, k, v), w = make_qkv(), torch.randn(2, 3, 4, 6, 2, 8)
    output, o_v, o_w = (grid_attention(q, k, t, 2, backend) for t in (a * v + b * w, v, w))
    sizes = output.norm() + abs(a) * o_v.norm() + abs(b) * o_w.norm()
    assert (output - a * o_v - b * o_w).norm() <= ERROR[torch.float32] * sizes


@per_backend
@few
@given(order=st.permutations(range(4)), seed=st.integers(0, 10**6))
def test_permuting_views_and_heads(backend, order, seed):
    torch.manual_seed(seed)
    qkv = make_qkv(views=4, heads=4)
    expected = grid_attention(*qkv, 2, backend)[:, order][..., order, :]
    output = grid_attention(*(t[:, order][..., order, :] for t in qkv), 2, backend)
    assert relative_error(output, expected) <= 2 * ERROR[torch.float32]


def unchecked(*arguments, **options):
    """Call it without the tests' type checker, which would raise first."""
    return inspect.unwrap(grid_attention)(*arguments, **options)


@per_backend
@pytest.mark.parametrize("name", range(3), ids="qkv".__getitem__)
def test_bad_input(backend, name):
    def bad(change):
        qkv = make_qkv()
        qkv[name] = change(qkv[name])
        return qkv

    field = rf"grid_attention's {'qkv'[name]}"
    with pytest.raises(InputError, match=rf"{field} has shape \(.*\): expected [([]"):
        unchecked(*bad(lambda t: t[0]), 2, backend)
    with pytest.raises(InputError, match=rf"{field} is torch.int64: give floating-point numbers"):
        unchecked(*bad(torch.Tensor.long), 2, backend)
    if name:
        with pytest.raises(InputError, match=rf"{field} has shape \(.*\): expected [([]"):
            unchecked(*bad(lambda t: t[:, :1]), 2, backend)
        with pytest.raises(InputError, match=rf"{field} is on meta and q on cpu"):
            unchecked(*bad(lambda t: t.to("meta")), 2, backend)


@per_backend
@pytest.mark.parametrize("grid", [0, -1])
def test_bad_grids(backend, grid):
    with pytest.raises(InputError, match=rf"grid={grid}"):
        grid_attention(*make_qkv(), grid, backend)


def test_a_token_attends_to_its_grid_place_in_all_views_only():
    q, k, v = torch.randn(3, 2, 3, 4, 6, 2, 8, dtype=torch.float64).unbind(0)
    v.requires_grad_()
    grid_attention(q, k, v, grid=2)[0, 0, 1, 2].sum().backward()
    attended = v.grad.abs().sum((-1, -2))[0] > 0
    expected = torch.zeros_like(attended)
    expected[:, 1::2, 0::2] = True
    assert torch.equal(attended, expected)
