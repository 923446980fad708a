"""The scans and backends under test, their arguments, and both passes."""

from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from asysplat.ops import selective_scan, ssd

SCANS = {"ssd": ssd, "selective_scan": selective_scan}
NAMES = ("x", "dt", "A", "B", "C", "D")
BACKENDS = ["chunked", "cpu"]
PATHS = [(name, backend) for name in SCANS for backend in BACKENDS]
EXACT_PATHS = [(name, backend) for name in SCANS for backend in ("reference", "chunked")]  # float64

ERROR = {torch.float32: 2e-6, torch.bfloat16: 1e-2, torch.float16: 1e-2}  # relative, L2
UNDERFLOW = 1e-30  # a smaller result may be 0: float32 cannot hold its factors

# dt: about equal for all tokens, of every size, and a mixture of huge and tiny ones.
STEPS = ("1e-8", "1e-4", "1", "1e3", "spread", "mixed")
RATES = ("1e-4", "1e-2", "1", "1e4", "spread")  # -A


@dataclass(frozen=True)
class Result:
    y: Tensor
    grads: tuple[Tensor, ...]

    def named(self) -> dict[str, Tensor]:
        return {"y": self.y} | dict(zip(NAMES, self.grads, strict=True))


def make_arguments(
    name: str,
    length: int,
    steps: str = "0.1",
    rates: str = "1",
    batch: int = 2,
    channels: int = 3,
    head_dim: int = 4,
    state: int = 5,
    dtype: torch.dtype = torch.float32,
    seed: int = 0,
) -> tuple[Tensor, ...]:
    """x, dt, A, B, C, D: x, B and C in `dtype`, the others in float32.

    dt and -A are drawn from half to one and a half of a number, or are a name of STEPS or RATES.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(shape, generator=generator)

    def sizes(kind: str, low: float, high: float, *shape) -> Tensor:
        uniform = torch.rand(shape, generator=generator)
        return low * (high / low) ** uniform if kind == "spread" else float(kind) * (0.5 + uniform)

    tail = (channels, head_dim) if name == "ssd" else (channels,)
    x, B, C = normal(batch, length, *tail), *normal(2, batch, length, state)
    dt = sizes("1e-8" if steps == "mixed" else steps, 1e-8, 1e3, batch, length, channels)
    if steps == "mixed":
        dt[:, ::5] *= 1e6
        dt[:, 3::11] = 1e3
    A = -sizes(rates, 1e-4, 1e4, *((channels,) if name == "ssd" else (channels, state)))
    return x.to(dtype), dt, A, B.to(dtype), C.to(dtype), normal(channels)


def random_grad_output(x: Tensor) -> Tensor:
    """Return a gradient of y, the same every time."""
    return torch.randn(x.shape, generator=torch.Generator().manual_seed(9)).to(x.dtype)


def both_ways(
    path: tuple[str, str],
    arguments: tuple[Tensor, ...],
    grad_output: Tensor | None = None,
    reverse: bool = False,
) -> Result:
    name, backend = path
    leaves = [argument.detach().clone().requires_grad_() for argument in arguments]
    y = SCANS[name](*leaves, backend=backend, reverse=reverse)
    grad_output = random_grad_output(arguments[0]) if grad_output is None else grad_output
    return Result(y.detach(), torch.autograd.grad(y, leaves, grad_output))


def by_loop(
    path: tuple[str, str],
    arguments: tuple[Tensor, ...],
    grad_output: Tensor | None = None,
    reverse: bool = False,
    dtype: torch.dtype = torch.float64,
) -> Result:
    """The same by a loop over the tokens, with gradients by hand."""
    x, dt, A, B, C, D = (argument.detach().to(dtype) for argument in arguments)
    grad_output = random_grad_output(arguments[0]) if grad_output is None else grad_output
    grad_output = grad_output.to(dtype)
    head_dim = x.shape[-1]
    if path[0] == "ssd":  # a selective scan whose channels and states share what a head has
        x, grad_output = x.flatten(2), grad_output.flatten(2)
        dt, D = dt.repeat_interleave(head_dim, -1), D.repeat_interleave(head_dim)
        A = A.repeat_interleave(head_dim)[:, None].expand(-1, B.shape[-1])
    x, dt, B, C, grad_output = (t.flip(1) if reverse else t for t in (x, dt, B, C, grad_output))
    arrays = (np.ascontiguousarray(t.numpy()) for t in (x, dt, A, B, C, D, grad_output))
    results = (torch.from_numpy(array) for array in _loop(*arrays))
    y, grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D = results
    y, grad_x, grad_dt, grad_B, grad_C = (
        t.flip(1) if reverse else t for t in (y, grad_x, grad_dt, grad_B, grad_C)
    )
    if path[0] == "ssd":
        y, grad_x = y.unflatten(-1, (-1, head_dim)), grad_x.unflatten(-1, (-1, head_dim))
        grad_dt, grad_D = (t.unflatten(-1, (-1, head_dim)).sum(-1) for t in (grad_dt, grad_D))
        grad_A = grad_A.unflatten(0, (-1, head_dim)).sum((1, 2))
    return Result(y, (grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D))


@numba.njit(cache=True)
def _loop(x, dt, A, B, C, D, grad_output):
    batch, length, channels = x.shape
    states = np.zeros((length + 1, A.shape[1]), x.dtype)  # that after t tokens at t
    grad_state = np.zeros(A.shape[1], x.dtype)
    y, grad_x, grad_dt = D * x, D * grad_output, np.zeros_like(x)
    grad_A, grad_B, grad_C = np.zeros_like(A), np.zeros_like(B), np.zeros_like(C)
    grad_D = np.zeros_like(D)
    for b in range(batch):
        for d in range(channels):
            for t in range(length):
                for n in range(A.shape[1]):
                    decay = np.exp(dt[b, t, d] * A[d, n])
                    new = dt[b, t, d] * x[b, t, d] * B[b, t, n]
                    states[t + 1, n] = decay * states[t, n] + new
                    y[b, t, d] += C[b, t, n] * states[t + 1, n]
            grad_state[:] = 0
            for t in range(length - 1, -1, -1):
                grad_D[d] += grad_output[b, t, d] * x[b, t, d]
                for n in range(A.shape[1]):
                    grad_C[b, t, n] += grad_output[b, t, d] * states[t + 1, n]
                    grad_state[n] += grad_output[b, t, d] * C[b, t, n]
                    grad_new = grad_state[n]
                    grad_x[b, t, d] += grad_new * dt[b, t, d] * B[b, t, n]
                    grad_B[b, t, n] += grad_new * dt[b, t, d] * x[b, t, d]
                    grad_state[n] *= np.exp(dt[b, t, d] * A[d, n])
                    grad_exponent = grad_state[n] * states[t, n]
                    grad_A[d, n] += grad_exponent * dt[b, t, d]
                    grad_dt[b, t, d] += grad_exponent * A[d, n]
                    grad_dt[b, t, d] += grad_new * x[b, t, d] * B[b, t, n]
    return y, grad_x, grad_dt, grad_A, grad_B, grad_C, grad_D


def relative_error(value: Tensor, exact: Tensor) -> float:
    value, exact = value.detach().double(), exact.detach().double()
    return float((value - exact).norm() / exact.norm().clamp(min=UNDERFLOW))


def errors(result: Result, exact: Result) -> dict[str, float]:
    others = exact.named()
    return {name: relative_error(value, others[name]) for name, value in result.named().items()}


def sum_error(grad: Tensor, whole: Tensor) -> float:
    """Compare the gradient of an expanded tensor with the sum of its elements' gradients; relative
    to the largest error of a sum of elements that are each as exact as they should be."""
    right = whole.double().sum_to_size(grad.shape)
    scale = whole.double().norm() * (whole.numel() / grad.numel()) ** 0.5
    return float((grad.double() - right).norm() / scale)


def assert_exact(
    path: tuple[str, str],
    arguments: tuple[Tensor, ...],
    grad_output: Tensor | None = None,
    reverse: bool = False,
    slack: float = 0,
) -> None:
    """An error up to `slack` times that of the loop in float32 passes, too."""
    result = both_ways(path, arguments, grad_output, reverse)
    for name, value in result.named().items():
        assert value.isfinite().all(), name
    exact = by_loop(path, arguments, grad_output, reverse)
    allowed = dict.fromkeys(result.named(), ERROR[arguments[0].dtype])
    if slack:
        single = errors(by_loop(path, arguments, grad_output, reverse, torch.float32), exact)
        allowed = {name: max(bound, slack * single[name]) for name, bound in allowed.items()}
    for name, error in errors(result, exact).items():
        assert error <= allowed[name], name
