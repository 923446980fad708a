"""Small cases on which the operators' kernels are compared with their references.

Each function takes a device and the name of a backend, and returns the relative errors of outputs
and gradients; see `asysplat.kernels.self_check`.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from asysplat import ops
from asysplat.kernels.dispatch import load_kernels
from asysplat.kernels.self_check import KernelResults, relative_errors, seeded_normal

TOKENS = 150  # no multiple of a chunk
Sample = Callable[..., Tensor]


def ssd(device: torch.device, backend: str) -> dict[str, float]:
    """Compare y and all gradients with those of the chunked form in float64."""
    sample = partial(_sample_scan, channels=(2, 64), decays=(2,), state=64)
    return _compare(ops.ssd, sample, device, (backend, "chunked"))


def selective_scan(device: torch.device, backend: str) -> dict[str, float]:
    """Compare y and all gradients with those of the chunked form in float64."""
    sample = partial(_sample_scan, channels=(64,), decays=(64, 16), state=16)
    return _compare(ops.selective_scan, sample, device, (backend, "chunked"))


def conv_silu(device: torch.device, backend: str) -> dict[str, float]:
    """Compare the output and all gradients, with channels that are no multiple of a block's."""

    def sample(draw: Sample) -> list[Tensor]:
        return [draw(2, TOKENS, 150), draw(150, 4), draw(150)]

    return _compare(partial(ops.conv_silu, before=2), sample, device, (backend, "reference"))


def grid_attention(device: torch.device, backend: str) -> dict[str, float]:
    """Compare the output and all gradients, with sides that are no multiple of the grid's."""

    def sample(draw: Sample) -> list[Tensor]:
        return [draw(1, 3, 5, 4, 2, 16) for _ in "qkv"]

    return _compare(partial(ops.grid_attention, grid=2), sample, device, (backend, "reference"))


def image_loss(device: torch.device, backend: str) -> dict[str, float]:
    """Compare the losses of two images and their gradients."""
    target = seeded_normal(device, torch.float64)(2, 3, 33, 40).sigmoid()

    def sample(draw: Sample) -> list[Tensor]:
        return [draw(2, 3, 33, 40).tanh()]

    loss = partial(ops.image_loss, target=target)
    return _compare(loss, sample, device, (backend, "reference"))


def adam(device: torch.device, backend: str) -> dict[str, float]:
    """Compare parameters and averages after two steps, with a row that is left out."""
    from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference

    kernels = getattr(load_kernels("adam", backend), f"adam_step_{backend}")
    settings, results = AdamSettings(0.9, 0.999, 1e-15), []
    for step, dtype in ((kernels, torch.float32), (adam_step_reference, torch.float64)):
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
        tensors = [tensor for row in rows for tensor in (row.parameter, row.mean, row.square)]
        results.append(KernelResults(tensors))
    return relative_errors(*results)


def plane_sweep(device: torch.device, backend: str) -> dict[str, float]:
    """Compare the costs, their contrasts, the counts of views and sums around pixels."""
    from asysplat.ops.plane_sweep import reference

    draw = seeded_normal(device, torch.float32)
    neighbors = torch.tensor([[[1, 2], [0, 2], [1, -1]]], device=device)
    motions = torch.eye(3, 4, device=device).repeat(1, 3, 2, 1, 1)
    motions[..., 3] = torch.tensor([4.0, 1.3, 0.1], device=device)  # pixels at inverse depth 1
    ranges = torch.tensor([0.2, 1.0], device=device).repeat(1, 3, 1)
    images, edges = draw(1, 3, 33, 40).sigmoid(), draw(1, 3, 2, 33, 40).sigmoid()
    inverse, trust = 0.2 + 0.8 * images, torch.ones_like(images)
    results = []
    for module in (load_kernels("plane_sweep", backend), reference):
        costs = module.cost_volume(images, neighbors, motions, ranges, 32)
        best = module.sgm(costs, trust, edges)
        steps = torch.full((1, 3), 0.02, device=device)
        counts = module.consistency(inverse, steps, trust, neighbors, motions)
        sums = module.spread(costs[..., :9], edges)
        results.append(KernelResults([costs, best.contrast, *counts, sums]))
    return relative_errors(*results)


def _sample_scan(
    draw: Sample, channels: tuple[int, ...], decays: tuple[int, ...], state: int
) -> list[Tensor]:
    x, B, C = draw(1, TOKENS, *channels), draw(1, TOKENS, state), draw(1, TOKENS, state)
    dt, A = draw(1, TOKENS, channels[0]).sigmoid(), -draw(*decays).exp()
    return [x, dt, A, B, C, draw(channels[0])]


def _compare(
    operator: Callable[..., Tensor],
    sample: Callable[[Sample], list[Tensor]],
    device: torch.device,
    backends: tuple[str, str],
) -> dict[str, float]:
    """Compare an operator's output and all gradients with those of its reference in float64."""
    results = []
    for backend, dtype in zip(backends, (torch.float32, torch.float64), strict=True):
        draw = seeded_normal(device, dtype)
        leaves = [tensor.requires_grad_() for tensor in sample(draw)]
        y = operator(*leaves, backend=backend)
        gradients = torch.autograd.grad(y, leaves, draw(*y.shape))
        results.append(KernelResults([y.detach()], gradients))
    return relative_errors(*results)
