"""The scans and backends under test, their arguments, and both passes."""

from dataclasses import dataclass

import torch
from loop import scan_loop
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

    Args:
        steps, rates: dt and -A: a number, from half to one and a half of which they are drawn, or
            a name of STEPS or RATES.
        channels: heads, for ssd; each of `head_dim`.
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
    """Run a backend forward and backward from `grad_output`, by default a random one."""
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
    """The same by the loop over the tokens: exact unless in float32."""
    grad_output = random_grad_output(arguments[0]) if grad_output is None else grad_output
    return Result(*scan_loop(path[0], arguments, grad_output, reverse, dtype))


def relative_error(value: Tensor, exact: Tensor) -> float:
    """L2."""
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
    """Check that the output and all gradients are finite and within the allowed error.

    Args:
        slack: for badly conditioned cases: an error up to so many times that of the loop in
            float32 passes, too.
    """
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
