"""Gradients of the float64 forms against finite differences."""

import pytest
import torch
from scans import EXACT_PATHS, SCANS, make_arguments

# Within a chunk, over its end, and with steps that clear the state.
CASES = {"short": (5, "0.1"), "long": (66, "0.1"), "forgetful": (66, "3")}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("path", EXACT_PATHS, ids="-".join)
def test_every_gradient_equals_finite_differences(path, case, reverse):
    name, backend = path
    length, steps = CASES[case]
    arguments = make_arguments(name, length, steps, batch=1, channels=2, head_dim=2, state=2)
    leaves = [argument.double().requires_grad_() for argument in arguments]
    assert torch.autograd.gradcheck(
        lambda *leaves: SCANS[name](*leaves, backend=backend, reverse=reverse),
        leaves,
        fast_mode=True,
    )
