"""Both scans: every form against the sequential reference in float64, and its gradients."""

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from asysplat.errors import InputError
from asysplat.ops import selective_scan, ssd


def ssd_arguments(batch=2, length=7, heads=3, head_dim=4, state=5, dtype=torch.float64):
    return (
        torch.randn(batch, length, heads, head_dim, dtype=dtype),
        torch.rand(batch, length, heads, dtype=dtype),
        -torch.rand(heads, dtype=dtype) - 0.1,
        torch.randn(batch, length, state, dtype=dtype),
        torch.randn(batch, length, state, dtype=dtype),
        torch.randn(heads, dtype=dtype),
    )


def selective_arguments(batch=2, length=7, channels=3, state=5, dtype=torch.float64):
    return (
        torch.randn(batch, length, channels, dtype=dtype),
        torch.rand(batch, length, channels, dtype=dtype),
        -torch.rand(channels, state, dtype=dtype) - 0.1,
        torch.randn(batch, length, state, dtype=dtype),
        torch.randn(batch, length, state, dtype=dtype),
        torch.randn(channels, dtype=dtype),
    )


SCANS = {
    "ssd": (ssd, ssd_arguments, "chunked"),
    "selective_scan": (selective_scan, selective_arguments, "chunked"),
}


@pytest.mark.parametrize("name", SCANS)
def test_one_token_is_the_formula(name):
    scan, make, _ = SCANS[name]
    x, dt, A, B, C, D = make(length=1)
    gain = (B * C).sum(-1)
    expand = (..., None) if name == "ssd" else (...,)
    weight = (dt * gain[..., None])[expand] + (D[:, None] if name == "ssd" else D)
    torch.testing.assert_close(scan(x, dt, A, B, C, D, backend="reference"), weight * x)


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("length", [1, 17, 63, 64, 65, 200])
@pytest.mark.parametrize("reverse", [False, True])
def test_fast_form_equals_reference(name, length, reverse):
    scan, make, fast = SCANS[name]
    arguments = make(length=length)
    expected = scan(*arguments, backend="reference", reverse=reverse)
    torch.testing.assert_close(scan(*arguments, backend=fast, reverse=reverse), expected)
    single = scan(*(a.float() for a in arguments), backend=fast, reverse=reverse)
    assert (single - expected).norm() / expected.norm() < 2e-6


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("backend", ["reference", "fast"])
def test_gradcheck(name, backend):
    scan, make, fast = SCANS[name]
    length = 5 if backend == "reference" else 66
    arguments = make(batch=1, length=length, state=2)
    for tensor in arguments:
        tensor.requires_grad_()
    backend = fast if backend == "fast" else backend
    assert torch.autograd.gradcheck(
        lambda *a: scan(*a, backend=backend, reverse=True), arguments, fast_mode=True
    )


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("step", [1e-8, 1e3])
def test_extreme_steps_stay_finite(name, step):
    scan, make, _ = SCANS[name]
    x, dt, A, B, C, D = make(length=130, dtype=torch.float32)
    arguments = [x, torch.full_like(dt, step), A * 1e4, B, C, D]
    for tensor in arguments:
        tensor.requires_grad_()
    y = scan(*arguments)
    y.sum().backward()
    assert y.isfinite().all()
    assert all(tensor.grad.isfinite().all() for tensor in arguments)


@pytest.mark.parametrize("name", SCANS)
def test_half_precision_is_computed_in_fp32(name):
    scan, make, _ = SCANS[name]
    arguments = [a.bfloat16() for a in make(length=100)]
    y = scan(*arguments)
    assert y.dtype == torch.bfloat16
    torch.testing.assert_close(y, scan(*(a.float() for a in arguments)).bfloat16())


@pytest.mark.parametrize("name", SCANS)
def test_unknown_backend(name):
    scan, make, _ = SCANS[name]
    with pytest.raises(InputError, match="backend='fast'"):
        scan(*make(), backend="fast")


@pytest.mark.parametrize("name", SCANS)
def test_torch_sees_one_operator(name):
    """opcheck (schema, autograd, meta device, AOT dispatch), and torch.compile in one graph."""
    scan, make, _ = SCANS[name]
    arguments = [a.requires_grad_() for a in make(length=70, dtype=torch.float32)]
    operator = getattr(torch.ops.asysplat, name).default
    torch.library.opcheck(operator, ("cpu", *arguments, True, True))
    torch.library.opcheck(operator, ("cpu", *(a.detach() for a in arguments), True, False))

    # The public function less what checks its shapes in tests, which cannot be compiled.
    @torch.compile(backend="aot_eager", fullgraph=True)
    def compiled(*arguments):
        return operator("cpu", *arguments, False, True)[0]

    expected, got = scan(*arguments), compiled(*arguments)
    assert torch.equal(got, expected)
    grads = [torch.autograd.grad(y.square().sum(), arguments) for y in (expected, got)]
    assert all(map(torch.equal, *grads))


@pytest.mark.parametrize("name", SCANS)
def test_nothing_is_kept_where_no_gradient_is_asked_for(name):
    scan, make, _ = SCANS[name]
    arguments = make(length=70, dtype=torch.float32)
    operator = getattr(torch.ops.asysplat, name).default
    y, saved_state = operator("cpu", *arguments, False, True)
    without, nothing = operator("cpu", *arguments, False, False)
    assert torch.equal(without, y) and saved_state.numel() > 0 and nothing.numel() == 0
    assert torch.equal(scan(*arguments), y)


@pytest.mark.parametrize("name", SCANS)
def test_flops_are_counted_on_the_meta_device(name):
    scan, make, _ = SCANS[name]
    arguments = [a.to("meta").requires_grad_() for a in make(length=128, dtype=torch.float32)]
    with FlopCounterMode(display=False) as counter:
        y = scan(*arguments)
        forward = counter.get_total_flops()
        y.sum().backward()
    # One product or more for each, of all states.
    assert forward > 2 * arguments[0].numel() * 5
    assert counter.get_total_flops() > 3 * forward
