"""Optimizers and the learning rate of each step."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


def cosine(optimizer: Optimizer, warmup_steps: int, total_steps: int) -> LambdaLR:
    """Return the schedule of a linear warm-up, part of the total, then a cosine to 0."""

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        progress = (step - warmup_steps) / max(1, total_steps - warmup_steps)
        return 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))

    return LambdaLR(optimizer, factor)


class JointOptimizer(Optimizer):
    """Steps optimizers of disjoint parameters as one, whose state and groups are those of all."""

    def __init__(self, *optimizers: Optimizer):
        self.optimizers = optimizers
        super().__init__([group for part in optimizers for group in part.param_groups], {})
        self._share()

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Step every optimizer, after the closure has computed the gradients."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self.optimizers:
            part.step()
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._share()

    def _share(self) -> None:
        """Give every optimizer its groups and the common state, as the same objects."""
        self.state = defaultdict(dict, self.state)
        start = 0
        for part in self.optimizers:
            count = len(part.param_groups)
            part.param_groups = self.param_groups[start : start + count]
            part.state = self.state
            start += count


QUINTIC = (3.4445, -4.7750, 2.0315)  # Jordan's: singular values go to about 0.7 to 1.2
STEPS = 5


class Muon(Optimizer):
    """Momentum whose singular values become about 1 (Jordan et al. 2024), for matrices only.

    torch.optim.Muon does the same matrix by matrix, in bfloat16, which most CPUs emulate; here
    matrices of one shape are multiplied together, in float32 on a CPU: 3.5 times as fast.

    Args:
        rms: root mean square of a step at learning rate 1; 0.2 is about that of AdamW's in a long
            training (Liu et al. 2025, "Muon is scalable", Eq. 4).
        momentum: decay of the mean of gradients; Nesterov's.
    """

    def __init__(
        self,
        params: Iterable[Tensor],
        lr: float = 1e-3,
        rms: float = 0.2,
        momentum: float = 0.95,
        weight_decay: float = 0.0,
    ):
        defaults = {"lr": lr, "rms": rms, "momentum": momentum, "weight_decay": weight_decay}
        super().__init__(params, defaults)

    @torch.no_grad()
    def step(self) -> None:
        for group in self.param_groups:
            lr, kept = group["lr"], 1 - group["lr"] * group["weight_decay"]
            same_shape: dict[torch.Size, list[Tensor]] = defaultdict(list)
            for matrix in group["params"]:
                if matrix.grad is not None:
                    same_shape[matrix.shape].append(matrix)
            for shape, matrices in same_shape.items():
                ahead = [self._look_ahead(matrix, group["momentum"]) for matrix in matrices]
                steps = orthogonalize(torch.stack(ahead)).to(ahead[0].dtype)
                for matrix, step in zip(matrices, steps, strict=True):
                    matrix.mul_(kept).sub_(step, alpha=lr * group["rms"] * max(shape) ** 0.5)

    def _look_ahead(self, matrix: Tensor, decay: float) -> Float[Tensor, "m n"]:
        """Update a matrix's momentum; return it with the gradient added once more (Nesterov)."""
        state = self.state[matrix]
        if not state:
            state["momentum"] = torch.zeros_like(matrix)
        momentum = state["momentum"].lerp_(matrix.grad, 1 - decay)
        return matrix.grad.lerp(momentum, decay)


def orthogonalize(matrices: Float[Tensor, "K m n"]) -> Float[Tensor, "K m n"]:
    """Compute U V^T of the decompositions U S V^T, roughly, by Newton-Schulz iterations."""
    if matrices.shape[1] > matrices.shape[2]:
        return orthogonalize(matrices.mT).mT
    x = matrices.to(torch.bfloat16 if matrices.is_cuda else torch.float32)
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp_min(1e-7)
    a, b, c = QUINTIC
    for _ in range(STEPS):
        square = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x
