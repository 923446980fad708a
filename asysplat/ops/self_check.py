"""Small cases on which the operators' GPU kernels are compared with their references.

Each function returns the largest relative error; see `asysplat.kernels.self_check`.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from asysplat import ops
from asysplat.kernels.self_check import relative_error, seeded_normal

TOKENS = 150  # no multiple of a chunk


def ssd(device: torch.device) -> float:
    """Compare y and all gradients with those of the chunked form in float64."""
    return _compare_scan(ops.ssd, device, channels=(2, 64), decays=(2,), state=64)


def selective_scan(device: torch.device) -> float:
    """Compare y and all gradients with those of the chunked form in float64."""
    return _compare_scan(ops.selective_scan, device, channels=(64,), decays=(64, 16), state=16)


def adam(device: torch.device) -> float:
    """Compare parameters and averages after two steps, with a row that is left out."""
    from asysplat.ops.adam.cuda import adam_step_cuda
    from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference

    settings, results = AdamSettings(0.9, 0.999, 1e-15), []
    for step, dtype in ((adam_step_cuda, torch.float32), (adam_step_reference, torch.float64)):
        draw = seeded_normal(device, dtype)
        visible = draw(200) > 0
        rows = []
        for numbers in (3, 12):  # means, and SH of degree 1
            parameter, gradient = draw(200, numbers), draw(200, numbers)
            gradient[1, 2] = torch.nan
            state = torch.zeros_like(parameter), torch.zeros_like(parameter)
            steps = torch.zeros(200, dtype=torch.int32, device=device)
            rates = torch.full((numbers,), 0.01, dtype=dtype, device=device)
            rows.append(Rows(parameter, gradient, *state, steps, rates))
        for _ in range(2):
            step(rows, visible, settings)
        results.append([tensor for row in rows for tensor in (row.parameter, row.mean, row.square)])
    return relative_error(*results)


def plane_sweep(device: torch.device) -> float:
    """Compare the costs, their contrasts and the counts of views."""
    from asysplat.ops.plane_sweep import cuda, reference

    draw = seeded_normal(device, torch.float32)
    neighbors = torch.tensor([[[1, 2], [0, 2], [1, -1]]], device=device)
    motions = torch.eye(3, 4, device=device).repeat(1, 3, 2, 1, 1)
    motions[..., 3] = torch.tensor([4.0, 1.3, 0.1], device=device)  # pixels at inverse depth 1
    ranges = torch.tensor([0.2, 1.0], device=device).repeat(1, 3, 1)
    images, edges = draw(1, 3, 33, 40).sigmoid(), draw(1, 3, 2, 33, 40).sigmoid()
    inverse, trust = 0.2 + 0.8 * images, torch.ones_like(images)
    results = []
    for backend in (cuda, reference):
        costs = backend.cost_volume(images, neighbors, motions, ranges, 32)
        best = backend.sgm(costs, trust, edges)
        steps = torch.full((1, 3), 0.02, device=device)
        counts = backend.consistency(inverse, steps, trust, neighbors, motions)
        results.append([costs, best.contrast, *counts])
    return relative_error(*results)


def _compare_scan(
    operator: Callable[..., Tensor],
    device: torch.device,
    channels: tuple[int, ...],
    decays: tuple[int, ...],
    state: int,
) -> float:
    results = []
    for backend, dtype in (("cuda", torch.float32), ("chunked", torch.float64)):
        draw = seeded_normal(device, dtype)
        x, B, C = draw(1, TOKENS, *channels), draw(1, TOKENS, state), draw(1, TOKENS, state)
        dt, A = draw(1, TOKENS, channels[0]).sigmoid(), -draw(*decays).exp()
        leaves = [tensor.requires_grad_() for tensor in (x, dt, A, B, C, draw(channels[0]))]
        y = operator(*leaves, backend=backend)
        results.append([y.detach(), *torch.autograd.grad(y, leaves, draw(*y.shape))])
    return relative_error(*results)
