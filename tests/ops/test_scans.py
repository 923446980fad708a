"""Both scans as operators of torch; stress/ compares their backends with a loop."""

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from asysplat.errors import InputError
from asysplat.ops import selective_scan, ssd

SCANS = {"ssd": ssd, "selective_scan": selective_scan}
per_scan = pytest.mark.parametrize("name", SCANS)


def make(name, length=7, dtype=torch.float64, batch=2, channels=3, head_dim=4, state=5):
    """x, dt, A, B, C, D; `channels` heads of `head_dim` for ssd."""
    heads = (channels, head_dim) if name == "ssd" else (channels,)
    rates = (channels,) if name == "ssd" else (channels, state)
    return (
        torch.randn(batch, length, *heads, dtype=dtype),
        torch.rand(batch, length, channels, dtype=dtype),
        -torch.rand(rates, dtype=dtype) - 0.1,
        torch.randn(batch, length, state, dtype=dtype),
        torch.randn(batch, length, state, dtype=dtype),
        torch.randn(channels, dtype=dtype),
    )


@per_scan
def test_one_token_is_the_formula(name):
    scan = SCANS[name]
    x, dt, A, B, C, D = make(name, length=1)
    gain = (B * C).sum(-1)
    expand = (..., None) if name == "ssd" else (...,)
    weight = (dt * gain[..., None])[expand] + (D[:, None] if name == "ssd" else D)
    torch.testing.assert_close(scan(x, dt, A, B, C, D, backend="reference"), weight * x)


@per_scan
def test_half_precision_is_computed_in_fp32(name):
    scan = SCANS[name]
    arguments = [a.bfloat16() for a in make(name, length=100)]
    y = scan(*arguments)
    assert y.dtype == torch.bfloat16
    torch.testing.assert_close(y, scan(*(a.float() for a in arguments)).bfloat16())


@per_scan
def test_unknown_backend(name):
    scan = SCANS[name]
    with pytest.raises(InputError, match="backend='fast'"):
        scan(*make(name), backend="fast")


@per_scan
def test_each_scan_is_one_operator_of_torch(name):
    """opcheck (schema, autograd, meta device, AOT dispatch), and torch.compile in one graph."""
    scan = SCANS[name]
    arguments = [a.requires_grad_() for a in make(name, length=70, dtype=torch.float32)]
    operator = getattr(torch.ops.asysplat, name).default
    torch.library.opcheck(operator, ("cpu", *arguments, True, True))
    torch.library.opcheck(operator, ("cpu", *(a.detach() for a in arguments), True, False))

    # The operator itself: the shape checks that wrap the public function in tests do not compile.
    @torch.compile(backend="aot_eager", fullgraph=True)
    def compiled(*arguments):
        return operator("cpu", *arguments, False, True)[0]

    expected, got = scan(*arguments), compiled(*arguments)
    assert torch.equal(got, expected)
    grads = [torch.autograd.grad(y.square().sum(), arguments) for y in (expected, got)]
    assert all(map(torch.equal, *grads))


@per_scan
def test_no_state_is_saved_without_gradients(name):
    scan = SCANS[name]
    arguments = make(name, length=70, dtype=torch.float32)
    operator = getattr(torch.ops.asysplat, name).default
    y, saved_state = operator("cpu", *arguments, False, True)
    without, nothing = operator("cpu", *arguments, False, False)
    assert torch.equal(without, y) and saved_state.numel() > 0 and nothing.numel() == 0
    assert torch.equal(scan(*arguments), y)


@per_scan
def test_flops_are_counted_on_the_meta_device(name):
    scan = SCANS[name]
    arguments = [a.to("meta").requires_grad_() for a in make(name, length=128, dtype=torch.float32)]
    with FlopCounterMode(display=False) as counter:
        y = scan(*arguments)
        forward = counter.get_total_flops()
        y.sum().backward()
    # At least one product for each element of the states.
    assert forward > 2 * arguments[0].numel() * 5
    assert counter.get_total_flops() > 3 * forward
