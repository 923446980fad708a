"""The rule of the page: a result is compared with float64, and held to what rounding explains."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from asysplat.benchmark.options import PRECISIONS
from asysplat.benchmark.timing import Result

ALL_PRECISIONS = PRECISIONS | {"fp16": torch.float16}
IN_A_ROW = 256  # roundings of an operator, of which each goes into the next
NUDGES = 2  # times that the inputs are moved, of which the worst counts
RULE = (
    f"R = {IN_A_ROW**0.5:g} roundings, as many as {IN_A_ROW} in a row add up to like a random walk "
    "(of a network in fp32 32, as 1,024 do). The tolerance is what changes, in float64, when each "
    "number that goes in is moved by R halves of a unit in its last place, up or down at random "
    f"(the worse of {NUDGES} such moves; in a network also what each layer gives, forwards and "
    "backwards), and R halves of a unit in the last place of what comes out"
)
VANISHES = 1e-12  # of all gradients: one that is no more, and all of it noise, is 0 in truth
FLOAT64 = "float64"

Tensors = dict[str, Tensor]
Function = Callable[[Tensors], Tensors]


@dataclass(frozen=True)
class Case:
    """A line of the page.

    Args:
        area: the part of the project.
        name: what of it, and what is hostile.
        precision: of ALL_PRECISIONS.
        measure: returns the rest of the line, see `judge`.
    """

    area: str
    name: str
    precision: str
    measure: Callable[[], Result]

    def row(self) -> Result:
        """Measure; whatever is raised makes the line red."""
        what = {"area": self.area, "case": self.name, "precision": self.precision}
        try:
            return what | self.measure()
        except Exception as error:
            # A case that cannot run is a finding, and the others still run.
            return what | line(f"raised {type(error).__name__}: {error}", {}, green=False)


def line(
    compared: str,
    tensors: Mapping[str, Tensor],
    gradients: Collection[str] = (),
    *,
    green: bool,
    **numbers: object,
) -> Result:
    """Count what is not finite among the results, without which nothing is green.

    Args:
        compared: with what, in words.
        tensors: results by name.
        gradients: the names of those that are gradients.
        green: whether all else is as it should be.
        numbers: other keys of the line.

    Returns:
        "compared"; "worst", "error" and "tolerance", None unless given; "nan" and "inf", the
        numbers of those in all tensors; "gradients", whether all are finite, None without any;
        "green".
    """
    nan = sum(int(tensor.isnan().sum()) for tensor in tensors.values())
    inf = sum(int(tensor.isinf().sum()) for tensor in tensors.values())
    finite = all(bool(tensors[name].isfinite().all()) for name in gradients)
    found = {"compared": compared, "worst": None, "error": None, "tolerance": None} | numbers
    return found | {
        "nan": nan,
        "inf": inf,
        "gradients": finite if gradients else None,
        "green": green and nan == inf == 0,
    }


@dataclass(frozen=True)
class Comparison:
    """A function in a precision, and the same function in float64.

    Args:
        fast: what is judged: named tensors to named tensors.
        exact: the same, on float64.
        inputs: of `fast`; `exact` gets the same numbers.
        leaves: names of the inputs whose gradients are compared too.
        arithmetic: the float type that `fast` computes in, whatever its inputs are.
        network: that `exact` runs: what each of its layers gives goes in to the next.
        in_a_row: how many roundings of it go one into the next.
        exponent: the largest that it takes the exponential of: e^s is off by s roundings.
        size: of the numbers of an output, to which errors are relative where these are smaller.
        note: what else is to be said of the comparison.
    """

    fast: Function
    exact: Function
    inputs: Tensors
    leaves: tuple[str, ...] = ()
    arithmetic: torch.dtype = torch.float32
    network: nn.Module | None = None
    in_a_row: int = IN_A_ROW
    exponent: float = 1.0
    size: float = 0.0
    note: str = ""

    @property
    def roundings(self) -> float:
        """Return how many roundings, all to one side, err as much as those in a row."""
        return self.in_a_row**0.5


def judge(comparison: Comparison) -> Result:
    """Compare outputs and gradients with float64, each by its L2 norm, and apply RULE.

    Returns:
        See `line`: "worst" names the tensor that comes closest to its tolerance or is farthest
        beyond it, "error" and "tolerance" are its own, relative to its norm.
    """
    found = both_ways(comparison.fast, comparison.inputs, comparison.leaves)
    inputs = {name: tensor.double() for name, tensor in comparison.inputs.items()}
    exact = both_ways(comparison.exact, inputs, comparison.leaves)
    moved = [_moved(comparison, inputs, seed) for seed in range(NUDGES)]
    gradients = [f"gradient of {name}" for name in comparison.leaves]
    whole = torch.stack([torch.zeros(()).double(), *(exact[n].norm() for n in gradients)]).norm()
    held = {}
    for name, true in exact.items():
        explained = torch.stack([(other[name] - true).norm() for other in moved]).max()
        held[name] = _hold(comparison, found[name], true, explained, whole)
    worst = max(held, key=lambda name: held[name].share)
    return line(
        FLOAT64 + (f"; {comparison.note}" if comparison.note else ""),
        found,
        gradients,
        green=held[worst].share <= 1,
        worst=worst,
        **held[worst].numbers(),
    )


class Held(NamedTuple):
    """The error of a tensor and what it may be, in L2, and the norm of the tensor."""

    error: float
    tolerance: float
    norm: float

    @property
    def share(self) -> float:
        """Return the error over the tolerance; infinity where it is no number."""
        share = self.error / self.tolerance
        return math.inf if math.isnan(share) else share

    def numbers(self) -> Result:
        """Return both relative to the norm, None where they are no numbers."""
        values = {"error": self.error / self.norm, "tolerance": self.tolerance / self.norm}
        known = all(map(math.isfinite, values.values()))
        return values if known else dict.fromkeys(values)


def _hold(
    comparison: Comparison, found: Tensor, true: Tensor, explained: Tensor, whole: Tensor
) -> Held:
    """Hold a tensor to its tolerance.

    Args:
        explained: by how much `true` changes when what goes in is moved.
        whole: norm of all gradients.
    """
    norm = true.norm().clamp_min(comparison.size * true.numel() ** 0.5)
    own = comparison.exponent * unit(found.dtype) * norm
    if 0 < norm <= VANISHES * whole and explained >= norm / 2:
        own = unit(found.dtype) * whole
    own = own + least(found.dtype) * true.numel() ** 0.5
    tolerance = explained + comparison.roundings * own
    error = (found.double() - true).norm()
    return Held(float(error), float(tolerance), float(norm) or 1.0)


def both_ways(function: Function, inputs: Tensors, leaves: Collection[str]) -> Tensors:
    """Return the outputs, and the gradient of each leaf from random gradients of the outputs."""
    if not leaves:
        with torch.no_grad():
            return function(inputs)
    inputs = {n: t.detach().requires_grad_() if n in leaves else t for n, t in inputs.items()}
    outputs = function(inputs)
    weights = [_weights(output, seed) for seed, output in enumerate(outputs.values())]
    own = [inputs[name] for name in leaves]
    grads = torch.autograd.grad(list(outputs.values()), own, weights, materialize_grads=True)
    named = {f"gradient of {name}": grad for name, grad in zip(leaves, grads, strict=True)}
    return {name: output.detach() for name, output in outputs.items()} | named


def _weights(output: Tensor, seed: int) -> Tensor:
    """Return the same random numbers for an output in every precision: half of them all hold."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(output.shape, generator=generator).bfloat16().to(output)


def _moved(comparison: Comparison, inputs: Tensors, seed: int) -> Tensors:
    """Return what float64 gives when each number that goes in is moved."""
    generator = torch.Generator().manual_seed(seed)
    step = comparison.roundings * unit(comparison.arithmetic)

    def move(tensor: Tensor) -> Tensor:
        up = torch.rand(tensor.shape, generator=generator) < 0.5
        return tensor * torch.where(up, 1 + step, 1 - step)

    layers = [] if comparison.network is None else list(comparison.network.modules())
    layers = [layer for layer in layers if list(layer.parameters(recurse=False))]
    hooks = [layer.register_forward_hook(lambda *told: move(told[-1])) for layer in layers]
    hooks += [
        layer.register_full_backward_pre_hook(lambda _, grads: tuple(map(move, grads)))
        for layer in layers
    ]
    try:
        changed = {name: move(tensor) for name, tensor in inputs.items()}
        return both_ways(comparison.exact, changed, comparison.leaves)
    finally:
        for hook in hooks:
            hook.remove()


def unit(dtype: torch.dtype) -> float:
    """Return half a unit in the last place of 1, by which rounding errs at most."""
    return torch.finfo(dtype).eps / 2


def least(dtype: torch.dtype) -> float:
    """Return the least step between numbers, about which products that nearly vanish may err."""
    return torch.finfo(dtype).tiny * torch.finfo(dtype).eps
