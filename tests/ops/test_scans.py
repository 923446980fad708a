"""Both scans as operators of torch; stress/ compares their backends with a loop."""

import pytest
import torch
from scans import SCANS, make_arguments
from torch.utils.flop_counter import FlopCounterMode

per_scan = pytest.mark.parametrize("name", SCANS)


@per_scan
def test_one_token_is_the_formula(name):
    x, dt, A, B, C, D = make_arguments(name, 1)
    gain = (B * C).sum(-1)
    expand = (..., None) if name == "ssd" else (...,)
    weight = (dt * gain[..., None])[expand] + (D[:, None] if name == "ssd" else D)
    torch.testing.assert_close(SCANS[name](x, dt, A, B, C, D, backend="reference"), weight * x)


@per_scan
def test_each_scan_is_one_operator_of_torch(name):
    """opcheck (schema, autograd, meta device, AOT dispatch), and torch.compile in one graph."""
    scan = SCANS[name]
    arguments = [a.requires_grad_() for a in make_arguments(name, 70)]
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
    arguments = make_arguments(name, 70)
    operator = getattr(torch.ops.asysplat, name).default
    y, saved_state = operator("cpu", *arguments, False, True)
    without, nothing = operator("cpu", *arguments, False, False)
    assert torch.equal(without, y) and saved_state.numel() > 0 and nothing.numel() == 0


@per_scan
def test_flops_are_counted_on_the_meta_device(name):
    arguments = [a.to("meta").requires_grad_() for a in make_arguments(name, 128)]
    with FlopCounterMode(display=False) as counter:
        y = SCANS[name](*arguments)
        forward = counter.get_total_flops()
        y.sum().backward()
    # At least one product for each element of the states.
    assert forward > 2 * arguments[0].numel() * 5
    assert counter.get_total_flops() > 3 * forward
