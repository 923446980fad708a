"""Compare our numbers with the paper's: the order of a table's rows, and the costs of each."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr
from scipy.stats import t as student

from paper.tables import Claim, Costs, Number, PaperRow, PaperTable

# A smaller `signal` may come from the seeds alone: one table in twenty of six equal rows and three
# seeds exceeds it (the F distribution's 95 % is 3.1 = 1.76 ** 2).
CLEAR_SIGNAL = 1.76
# The largest accepted difference of our costs from the paper's, as a fraction of the paper's.
LIMITS = {"parameters": 0.015, "gflops": 0.03, "gaussians": 0.07}  # printed in whole millions


class RankAgreement(NamedTuple):
    """The agreement of our order of the rows with the paper's."""

    rho: float | None  # Spearman's; None below three rows, and where all rows are equal
    rows: int  # rows that have both numbers
    # Standard deviation between the rows' means, over the one that such means of equal rows would
    # have by their seeds alone: the root of the F statistic, about 1 where rows are equal. None
    # where every row has a single seed.
    signal: float | None


def mean_and_std(values: Sequence[Number]) -> tuple[float, float | None]:
    """Return mean and sample standard deviation over seeds; None for that of a single seed."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None


def paired_difference(
    row: PaperRow, base: PaperRow, column: str
) -> tuple[float, float | None] | None:
    """Compare two rows in the seeds that both have: mean difference, and half of its interval.

    The interval holds the true mean difference with 95 % confidence, by Student's t; None for one
    seed. Seeds share scenes and their order, so that their differences vary less than each row.

    Returns:
        None where no seed has both numbers.
    """
    numbers = [(side.seeds, side.values.get(column, ())) for side in (row, base)]
    # A list that lacks a seed does not tell which.
    sides = [dict(zip(*n, strict=True)) if len(n[0]) == len(n[1]) else {} for n in numbers]
    differences = [
        sides[0][seed] - sides[1][seed] for seed in sorted(set.intersection(*map(set, sides)))
    ]
    if not differences:
        return None
    mean, std = mean_and_std(differences)
    count = len(differences)
    half = None if std is None else std / math.sqrt(count) * float(student.ppf(0.975, count - 1))
    return mean, half


def rank_agreement(filled: PaperTable, column: str) -> RankAgreement:
    """Compare the paper's numbers with our means in the column of this key."""
    both = [row for row in filled.rows if column in row.numbers and row.values.get(column)]
    ours = np.array([np.mean(row.values[column]) for row in both])
    paper = np.array([row.numbers[column] for row in both])
    within = pooled_std([row.values[column] for row in both])
    signal = None
    if len(both) > 1 and within is not None:
        seeds = float(np.mean([len(row.values[column]) for row in both]))
        between = float(np.std(ours, ddof=1))
        signal = between / (within / math.sqrt(seeds)) if within else math.inf
    return RankAgreement(spearman(paper, ours), len(both), signal)


def spearman(first: np.ndarray, second: np.ndarray) -> float | None:
    """Return the correlation of the ranks; equal values share their mean rank.

    None below three values, and where either side is constant.
    """
    if len(first) < 3 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(spearmanr(first, second).statistic)


def pooled_std(groups: Sequence[Sequence[Number]]) -> float | None:
    """Return the standard deviation within groups, weighted by their degrees of freedom.

    None where each has a single value.
    """
    freedom = sum(len(group) - 1 for group in groups)
    if freedom <= 0:
        return None
    squares = sum(float(np.var(group)) * len(group) for group in groups)
    return math.sqrt(squares / freedom)


def claim_value(claim: Claim, number: Callable[[PaperRow], Number | None]) -> float | None:
    """Compute a claim from numbers of its rows, summed on each side; None where one is missing.

    "reduction" is 1 - first side / second side, "speedup" second / first, "gain" first - second,
    "total" the first.
    """
    numbers = [[number(row) for row in side] for side in claim.rows]
    if any(None in side for side in numbers):
        return None
    first, *others = map(sum, numbers)
    if claim.form == "total":
        return float(first)
    (second,) = others
    values = {"reduction": 1 - first / second, "speedup": second / first, "gain": first - second}
    return values[claim.form]


def cost_errors(row: PaperRow, costs: Costs) -> dict[str, float]:
    """Return the relative error of each cost that has a limit and that the paper prints."""
    return {key: costs[key] / row.numbers[key] - 1 for key in LIMITS if key in row.numbers}


def fits(row: PaperRow, costs: Costs) -> bool:
    """Return whether every cost is within its limit of the paper's."""
    return all(abs(error) <= LIMITS[key] for key, error in cost_errors(row, costs).items())


def check_costs(row: PaperRow) -> str:
    """Compare a row's costs with the paper's; only a row of known architecture can be "off"."""
    if row.quoted:
        return "quoted"
    if row.costs is None:
        return "not computed"
    if not cost_errors(row, row.costs):
        return "not printed"
    fit = fits(row, row.costs)
    if row.unverified:
        return "unverified, fits" if fit else "unverified, no fit"
    return "fits" if fit else "off"
