"""The rule of the suite: compare a result with float64, and allow for what rounding explains."""

import math
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.options import PRECISIONS
from benchmarks.timing import Result

ALL_PRECISIONS = PRECISIONS | {"fp16": torch.float16}
ROUNDINGS = 256  # roundings of an operator in sequence
PERTURBATIONS = 2  # random perturbations of the inputs; the worst counts
RULE = (
    "A case is green if all results and gradients are finite, and the L2 error of each is within "
    "its tolerance (worst: the closest to it). The tolerance is the change in float64 when each "
    "input, and in a network each layer's output and gradient, moves by R halves of a unit in its "
    f"last place, up or down at random (the worse of {PERTURBATIONS}), plus R halves of a unit in "
    f"the last place of the result. R = {ROUNDINGS**0.5:g}, a random walk of {ROUNDINGS} "
    "roundings; for a network in fp32 32, of 1,024"
)
NEGLIGIBLE = 1e-12  # fraction of all gradients: a smaller one that consists of noise is 0 in truth

Tensors = dict[str, Tensor]
Function = Callable[[Tensors], Tensors]


class StabilityCase(NamedTuple):
    """A row of the results."""

    name: str  # the function and the hostile input
    precision: str  # one of ALL_PRECISIONS
    measure: Callable[[], Result]  # returns the rest of the row, see `make_row`

    def row(self) -> Result:
        """Measure; an exception makes the row red, and the other cases still run."""
        row = {"case": self.name, "precision": self.precision}
        try:
            return row | self.measure()
        except Exception as error:
            return row | make_row(f"raised {type(error).__name__}: {error}", {}, green=False)


def make_row(
    compared: str, results: Mapping[str, Tensor], *, green: bool, **numbers: object
) -> Result:
    """Count the non-finite numbers among the results and gradients; any makes the row red.

    Returns:
        "compared": what the results are compared with; "worst", "error" and "tolerance", None
        unless among `numbers`; "nan" and "inf", counted in all results; "green".
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
        exponent: the largest argument of an exponential: e^s errs by s roundings.
        magnitude: magnitude of an output's numbers; errors of smaller outputs are relative to it.

    Returns:
        See `make_row`. "worst" names the tensor with the largest ratio of error and tolerance;
        "error" and "tolerance" are its own, relative to its norm.
    """
    results = forward_backward(fast, inputs, leaves)
    inputs = {name: tensor.double() for name, tensor in inputs.items()}
    truth = forward_backward(exact, inputs, leaves)
    growth = roundings**0.5  # as many roundings, all to one side, err as much
    step = growth * unit(arithmetic)
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
        rounding_error = exponent * unit(result.dtype) * norm
        if 0 < norm <= NEGLIGIBLE * total and sensitivity >= norm / 2:
            rounding_error = unit(result.dtype) * total
        # Products that nearly underflow err by the smallest step between numbers.
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
    # Random numbers that every precision represents exactly.
    random = [torch.Generator().manual_seed(seed) for seed in range(len(outputs))]
    weights = [
        torch.randn(output.shape, generator=generator).bfloat16().to(output)
        for output, generator in zip(outputs.values(), random, strict=True)
    ]
    leaf_inputs = [inputs[name] for name in leaves]
    # Where the network has a prior, its opacities and colors depend on no leaf.
    pairs = zip(outputs.values(), weights, strict=True)
    ends, weights = zip(*(pair for pair in pairs if pair[0].requires_grad), strict=True)
    grads = torch.autograd.grad(ends, leaf_inputs, weights, materialize_grads=True)
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
    """Run the float64 function with each number moved by a relative `step`, up or down."""
    generator = torch.Generator().manual_seed(seed)

    def move(tensor: Tensor) -> Tensor:
        up = torch.rand(tensor.shape, generator=generator) < 0.5
        return tensor * torch.where(up, 1 + step, 1 - step)

    layers = [] if network is None else list(network.modules())
    layers = [layer for layer in layers if list(layer.parameters(recurse=False))]
    hooks = [layer.register_forward_hook(lambda _, __, output: move(output)) for layer in layers]
    hooks += [
        layer.register_full_backward_pre_hook(lambda _, grads: tuple(map(move, grads)))
        for layer in layers
    ]
    try:
        perturbed = {name: move(tensor) for name, tensor in inputs.items()}
        return forward_backward(exact, perturbed, leaves)
    finally:
        for hook in hooks:
            hook.remove()


def unit(dtype: torch.dtype) -> float:
    """Return half a unit in the last place of 1, the largest error of a rounding."""
    return torch.finfo(dtype).eps / 2
