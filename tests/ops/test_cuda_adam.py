"""The Triton kernels of Adam against the reference in float64: on a GPU, or interpreted."""

import pytest
import torch
from compiler import DEVICE, kernel

from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference

triton = pytest.importorskip("triton")

NUM = 300
NUMBERS = (1, 3, 4, 12, 48)  # of a row of each tensor


def make_tensors(dtype=torch.float32, device="cpu"):
    generator = torch.Generator().manual_seed(0)
    rows = []
    for numbers in NUMBERS:
        values = torch.randn(NUM, numbers, generator=generator).to(device, dtype)
        rates = torch.linspace(0, 0.1, numbers + 1)[1:].to(device, dtype)
        steps = torch.zeros(NUM, dtype=torch.int32, device=device)
        state = (torch.zeros_like(values), torch.zeros_like(values), steps)
        rows.append(Rows(values, torch.zeros_like(values), *state, rates))
    return rows


@pytest.mark.gpu
def test_every_run_gives_the_same_bits():
    from asysplat.ops.adam.cuda import adam_step_cuda

    runs = []
    for _ in range(20):
        generator = torch.Generator().manual_seed(1)
        rows = [each._replace(rates=10 * each.rates) for each in make_tensors(device=DEVICE)]
        visible = torch.ones(NUM, dtype=torch.bool, device=DEVICE)
        for _ in range(5):
            for each in rows:
                each.gradient.copy_(torch.randn(each.gradient.shape, generator=generator))
            adam_step_cuda(rows, visible, AdamSettings(0.9, 0.999, 1e-15))
        runs.append([each.parameter.clone() for each in rows])
    assert all(torch.equal(a, b) for run in runs[1:] for a, b in zip(runs[0], run, strict=True))


@kernel
@pytest.mark.parametrize("settings", [AdamSettings(0.9, 0.999, 1e-15), AdamSettings(0.0, 0.5, 0.1)])
def test_visible_rows_with_finite_gradients_are_those_of_the_reference(settings):
    from asysplat.ops.adam.cuda import adam_step_cuda

    exact, ours = make_tensors(torch.float64), make_tensors(device=DEVICE)
    begin = make_tensors()
    for step in range(5):
        visible = torch.rand(NUM) < 0.6
        visible[:3] = torch.tensor([True, True, False])
        visible[-1] = False  # in no step
        for a, b in zip(exact, ours, strict=True):
            gradient = torch.randn(a.gradient.shape) * 10 ** torch.linspace(-6, 4, NUM)[:, None]
            gradient[-1] = torch.nan
            if step == 2:
                gradient[0, -1], gradient[2, 0] = torch.inf, torch.nan
            if step == 3 and gradient.shape[1] == 4:
                gradient[1, 2] = torch.nan
            a.gradient.copy_(gradient)
            b.gradient.copy_(gradient)
        dropped = adam_step_reference(exact, visible, settings)
        assert adam_step_cuda(ours, visible.to(DEVICE), settings) == dropped == (step in (2, 3))
    for a, b, first in zip(exact, ours, begin, strict=True):
        assert torch.equal(a.steps, b.steps.cpu()) and a.steps.max() == 5
        gradient_sizes = 10 ** torch.linspace(-6, 4, NUM, dtype=torch.float64)[:, None]
        scales = {"parameter": 1.0, "mean": gradient_sizes, "square": gradient_sizes**2}
        for name, scale in scales.items():
            error = (getattr(b, name).cpu() - getattr(a, name)).abs() / scale
            assert error.max() <= 2e-6, name
        assert torch.equal(b.parameter[-1].cpu(), first.parameter[-1])
