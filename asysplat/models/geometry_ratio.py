"""Find widths that give the geometry branch a fraction of the parameters, the geometry_ratio."""

from collections.abc import Callable
from functools import cache
from itertools import combinations_with_replacement

import numpy as np

from asysplat.errors import InputError
from asysplat.models.layers import Widths
from asysplat.models.network import Network

RATIO_TOLERANCE = 0.015
TOTAL_TOLERANCE = 0.0095  # any two totals are then within 2 %
ATTEMPTS = 10  # models built and counted, for each number of layers

Build = Callable[[Widths, int], Network]


def solve_widths(
    build: Build, base: Widths, layers: int, ratio: float, budget: float = 1.0
) -> tuple[Widths, int]:
    """Find widths and appearance layers whose model has the budget and the geometry ratio.

    The number of layers changes only if the widths, multiples of the head_dim, cannot give the
    ratio. Parameter counts are quadratic polynomials in the widths, and the addition of a layer is
    one in the fine width: a few models on the meta device determine them, so the search is cheap.

    Args:
        build: widths, appearance layers -> model with a `geometry_ratio()`.
        base, layers: widths and appearance layers that define the total.
        ratio: parameters of the geometry branch over all.
        budget: total parameters over those of `base` and `layers`.
    """
    if not 0 < ratio < 1:
        raise InputError(f"geometry_ratio={ratio}: give a fraction between 0 and 1, such as 0.9.")
    target = budget * _count(build(base, layers))[0]
    candidates = _candidates(base)
    heads = candidates / base.head_dim
    samples = _samples(len(base.stages) + 1)
    counts = _counts(build, base, layers, samples)
    predicted = _quadratic_fit(samples, counts, heads)
    fine_alone = (samples[:, :-1] == samples[0, :-1]).all(axis=1)  # three samples: a quadratic
    # Of all widths within the tolerances, prefer those with the proportions of the stages.
    shape_error = np.log(candidates[:, :-1] / np.array(base.stages)).std(axis=1)

    @cache
    def added() -> np.ndarray:
        """Return the parameters of another layer, for each candidate."""
        more = _counts(build, base, layers + 1, samples[fine_alone]) - counts[fine_alone]
        return _quadratic_fit(samples[fine_alone, -1:], more, heads[:, -1:])

    def errors(parameters: np.ndarray) -> np.ndarray:
        """Return the larger error of parameters [n, 2], in units of its tolerance."""
        total, geometry = parameters.T
        ratio_error = np.abs(geometry / total - ratio) / RATIO_TOLERANCE
        return np.maximum(ratio_error, np.abs(total / target - 1) / TOTAL_TOLERANCE)

    closest, description = np.inf, ""
    for count in sorted(range(1, 3 * layers + 1), key=lambda n: (abs(n - layers), -n)):
        more_layers = count - layers
        error = errors(predicted + more_layers * added() if more_layers else predicted)
        rank = np.where(error < 1, error / 2 + shape_error, 1e3 + error)
        order = np.argsort(rank, kind="stable")  # the same widths on every machine
        # The polynomial ignores rounding and stages of equal width, so build and count the best
        # candidates, or if none is within the tolerances, only the closest for the message.
        attempts = ATTEMPTS if error[order[0]] < 1 else 1
        for row in candidates[order[:attempts]]:
            *stages, fine = (int(width) for width in row)
            widths = Widths(tuple(stages), fine, base.head_dim)
            total, geometry = _count(build(widths, count))
            exact = float(errors(np.array([[total, geometry]]))[0])
            if exact < 1:
                return widths, count
            if exact < closest:
                closest = exact
                description = (
                    f"stages {'/'.join(map(str, stages))} and an appearance branch {fine} wide in "
                    f"{count} layers a stage, with {geometry / total:.3f} of {total / 1e6:.2f}M"
                )
    raise InputError(
        f"geometry_ratio={ratio} cannot be met within {RATIO_TOLERANCE} at "
        f"{target / 1e6:.2f}M parameters with head_dim {base.head_dim}: closest come "
        f"{description}; ask for that ratio, or for another width."
    )


def _candidates(base: Widths) -> np.ndarray:
    """Return [n, stages + 1] multiples of the head_dim around the base."""
    limits = [int(1.8 * width / base.head_dim) + 1 for width in base.stages]
    stages = np.stack(np.meshgrid(*(np.arange(1, m + 1) for m in limits), indexing="ij"), -1)
    stages = stages.reshape(-1, len(base.stages))
    stages = stages[(np.diff(stages, axis=1) >= 0).all(axis=1)]
    fine = np.arange(1, 4 * base.fine // base.head_dim + 1)
    rows = np.repeat(stages, len(fine), axis=0)
    return np.column_stack((rows, np.tile(fine, len(stages)))) * base.head_dim


def _quadratic_terms(widths: np.ndarray) -> np.ndarray:
    """Return all products of at most two of the columns, and 1."""
    padded = np.column_stack((np.ones(len(widths)), widths))
    pairs = combinations_with_replacement(range(padded.shape[1]), 2)
    return np.stack([padded[:, i] * padded[:, j] for i, j in pairs], axis=1)


def _quadratic_fit(samples: np.ndarray, counts: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Evaluate the quadratic polynomials through `counts` [samples, 2] at `widths`: [n, 2]."""
    return _quadratic_terms(widths) @ np.linalg.solve(_quadratic_terms(samples), counts)


def _counts(build: Build, base: Widths, layers: int, samples: np.ndarray) -> np.ndarray:
    """Count the parameters [samples, 2], all and the geometry branch's; widths are in heads."""
    rows = (tuple(int(width) * base.head_dim for width in sample) for sample in samples)
    models = (build(Widths((*stages,), fine, base.head_dim), layers) for *stages, fine in rows)
    return np.array([_count(model) for model in models], dtype=np.float64)


def _samples(columns: int) -> np.ndarray:
    """Return points that determine a quadratic: a base, steps along each axis and pair of axes."""
    # Even, so that halves and sixteenths of a width are whole, and different: stages of equal width
    # have no projection between them.
    base = 4.0 + 8 * np.arange(columns)
    axes = 2 * np.eye(columns)
    single = [base + step * axis for axis in axes for step in (1, 2)]
    pairs = [base + axes[i] + axes[j] for i in range(columns) for j in range(i + 1, columns)]
    return np.stack([base, *single, *pairs])


def _count(model: Network) -> tuple[int, float]:
    total = sum(p.numel() for p in model.parameters())
    return total, total * model.geometry_ratio()
