"""The rule of the suite: compare results with float64, within what rounding can explain."""

import math
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.options import PRECISIONS
from benchmarks.timing import Result

ALL_PRECISIONS = PRECISIONS | {"fp16": torch.float16}
ROUNDINGS = 256  # roundings in sequence, allowed to an operator
PERTURBATIONS = 2  # random perturbations of the inputs, of which the worst counts
RULE = (
    "A case is green if all results and gradients are finite, and the L2 error of each is within "
    "its tolerance (worst: the one closest to it). The tolerance is the change in float64 when "
    "each input, and in a network each layer's output and gradient, is perturbed by R/2 units in "
    f"its last place, up or down at random (the worse of {PERTURBATIONS} draws), plus R/2 units in "
    f"the last place of the result. R is {ROUNDINGS**0.5:g}, as in a random walk of {ROUNDINGS} "
    "roundings, and 32 for a network in fp32, as in one of 1,024"
)
NEGLIGIBLE = 1e-12  # a gradient below this fraction of all may be noise around an exact 0

Tensors = dict[str, Tensor]
Function = Callable[[Tensors], Tensors]


class StabilityCase(NamedTuple):
    """A measurement that gives one row of the results."""

    name: str  # names the function and its hostile input
    precision: str  # key of ALL_PRECISIONS
    measure: Callable[[], Result]  # returns the other values of the row, see `make_row`

    def row(self) -> Result:
        """Measure the case; an exception makes its row red, so that the other cases still run."""
        row = {"case": self.name, "precision": self.precision}
        try:
            return row | self.measure()
        except Exception as error:
            return row | make_row(f"raised {type(error).__name__}: {error}", {}, green=False)


def make_row(
    compared: str, results: Mapping[str, Tensor], *, green: bool, **numbers: object
) -> Result:
    """Make the row of a case, which is red if any result or gradient is not finite.

    Args:
        compared: what the results were compared with, in words.
        results: results and gradients.
        green: whether the case is green, as far as errors decide.
        numbers: further values of the row.

    Returns:
        "compared"; "worst", "error" and "tolerance", None unless among `numbers`; "nan" and "inf",
        their counts in all results; "green".
    """
    nan = sum(int(tensor.isnan().sum()) for tensor in results.values())
    inf = sum(int(tensor.isinf().sum()) for tensor in results.values())
    row = {"compared": compared, "worst": None, "error": None, "tolerance": None} | numbers
    return row | {"nan": nan, "inf": inf, "green": green and nan == inf == 0}


def compare_to_reference(
    fast: Function,
    exact: Function,
    inputs: Tensors,
    leaves: tuple[str, ...] = (),
    *,
    arithmetic: torch.dtype = torch.float32,
    network: nn.Module | None = None,
    roundings: int = ROUNDINGS,
    exponent: float = 1.0,
    magnitude: float = 0.0,
) -> Result:
    """Compare outputs and gradients with float64, each by its L2 norm, and apply RULE.

    Args:
        fast: the function under test, from named tensors to named tensors.
        exact: the same function, for float64.
        inputs: inputs of `fast`; `exact` gets the same numbers.
        leaves: names of the inputs whose gradients are compared too.
        arithmetic: the float type in which `fast` computes, whatever its inputs are.
        network: network of `exact`, to perturb the outputs and gradients of its layers.
        roundings: number of roundings in sequence.
        exponent: largest argument s of an exponential, whose error is s roundings.
        magnitude: least magnitude of the numbers of an output, relative to which it may err.

    Returns:
        See `make_row`. "worst" names the tensor whose ratio of error to tolerance is largest;
        "error" and "tolerance" are those of this tensor, relative to its norm.
    """
    results = forward_backward(fast, inputs, leaves)
    inputs = {name: tensor.double() for name, tensor in inputs.items()}
    truth = forward_backward(exact, inputs, leaves)
    growth = roundings**0.5  # the error of a random walk, in steps of one rounding
    step = growth * unit_roundoff(arithmetic)
    perturbed = [
        _perturb(exact, inputs, leaves, network, step, seed) for seed in range(PERTURBATIONS)
    ]
    gradients = [truth[f"gradient of {name}"].norm() for name in leaves]
    total = torch.stack([torch.zeros(()).double(), *gradients]).norm()
    numbers = []
    for name, true in truth.items():
        result, root = results[name], true.numel() ** 0.5
        differences = [(perturbation[name] - true).norm() for perturbation in perturbed]
        sensitivity = torch.stack(differences).max()
        norm = true.norm().clamp_min(magnitude * root)
        rounding_error = exponent * unit_roundoff(result.dtype) * norm
        if 0 < norm <= NEGLIGIBLE * total and sensitivity >= norm / 2:
            rounding_error = unit_roundoff(result.dtype) * total
        # Products that nearly underflow have an error of the smallest step between numbers.
        limits = torch.finfo(result.dtype)
        tolerance = float(sensitivity + growth * (rounding_error + limits.tiny * limits.eps * root))
        error = float((result.double() - true).norm())
        ratio = error / tolerance
        numbers.append((math.inf if math.isnan(ratio) else ratio, name, error, tolerance, norm))
    ratio, worst, error, tolerance, norm = max(numbers, key=lambda number: number[0])
    norm = float(norm) or 1.0
    relative = {"error": error / norm, "tolerance": tolerance / norm}
    if not all(map(math.isfinite, relative.values())):
        relative = dict.fromkeys(relative)
    return make_row("float64", results, green=ratio <= 1, worst=worst, **relative)


def forward_backward(function: Function, inputs: Tensors, leaves: Collection[str]) -> Tensors:
    """Compute outputs, and gradients of the leaves from random gradients of the outputs."""
    if not leaves:
        with torch.no_grad():
            return function(inputs)
    inputs = {n: t.detach().requires_grad_() if n in leaves else t for n, t in inputs.items()}
    outputs = function(inputs)
    # Random numbers that every precision represents exactly
    random = [torch.Generator().manual_seed(seed) for seed in range(len(outputs))]
    weights = [
        torch.randn(output.shape, generator=generator).bfloat16().to(output)
        for output, generator in zip(outputs.values(), random, strict=True)
    ]
    leaf_inputs = [inputs[name] for name in leaves]
    values = list(outputs.values())
    grads = torch.autograd.grad(values, leaf_inputs, weights, materialize_grads=True)
    named = {f"gradient of {name}": grad for name, grad in zip(leaves, grads, strict=True)}
    return {name: output.detach() for name, output in outputs.items()} | named


def _perturb(
    exact: Function,
    inputs: Tensors,
    leaves: Collection[str],
    network: nn.Module | None,
    step: float,
    seed: int,
) -> Tensors:
    """Run the float64 function with each number perturbed by a relative `step`, up or down."""
    generator = torch.Generator().manual_seed(seed)

    def perturb(tensor: Tensor) -> Tensor:
        up = torch.rand(tensor.shape, generator=generator) < 0.5
        return tensor * torch.where(up, 1 + step, 1 - step)

    layers = [] if network is None else list(network.modules())
    layers = [layer for layer in layers if list(layer.parameters(recurse=False))]
    hooks = [layer.register_forward_hook(lambda _, __, output: perturb(output)) for layer in layers]
    hooks += [
        layer.register_full_backward_pre_hook(lambda _, grads: tuple(map(perturb, grads)))
        for layer in layers
    ]
    try:
        perturbed = {name: perturb(tensor) for name, tensor in inputs.items()}
        return forward_backward(exact, perturbed, leaves)
    finally:
        for hook in hooks:
            hook.remove()


def unit_roundoff(dtype: torch.dtype) -> float:
    """Return half a unit in the last place of 1, the largest relative error of a rounding."""
    return torch.finfo(dtype).eps / 2
