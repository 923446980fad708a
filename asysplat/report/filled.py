"""A table of the paper with our numbers in it, and what they say together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import spearmanr

from asysplat.report.paper import Column, PaperRow, PaperTable

Number = int | float
# Keyed as in metrics.json without "cost/": parameters, geometry_share, gflops (as the paper
# counts), gflops_true, gaussians, activation_gb.
Costs = dict[str, Number]

# Columns that need no run: they are shown among the costs, at the paper's scale.
COMPUTED = ("parameters", "gflops", "gaussians")

# Below this, rows may differ by the luck of their seeds: one table in twenty of six equal rows and
# three seeds exceeds it (the F distribution's 95 % is 3.1 = 1.76 ** 2).
CLEAR_SIGNAL = 1.76

# How far our costs may be from the paper's, as a fraction of the paper's.
LIMITS = {"parameters": 0.015, "gflops": 0.03}


@dataclass(frozen=True)
class FilledRow:
    """One method with what we measured of it.

    Args:
        paper: the row as the paper has it.
        costs: at the paper's scale; None where not asked for, and for quoted rows.
        reading_costs: one for each of `paper.readings`, or empty where not asked for.
        values: column key -> measured numbers, one for each seed; a column without any was not run.
        seeds: that were measured.
        revisions: of the code that measured them, see `asysplat.training.revision`.
        missing: seeds still to be run.
        note: what a reader should know of this row, such as "needs evaluate.py".
    """

    paper: PaperRow
    costs: Costs | None = None
    reading_costs: tuple[Costs, ...] = ()
    values: dict[str, list[Number]] = field(default_factory=dict)
    seeds: tuple[int, ...] = ()
    revisions: tuple[str, ...] = ()
    missing: tuple[int, ...] = ()
    note: str = ""

    @property
    def name(self) -> str:
        return self.paper.name + (" †" if self.paper.unverified else "")


@dataclass(frozen=True)
class FilledTable:
    """One table of the paper with our rows beside it.

    Args:
        paper: the table as the paper has it.
        rows: in the paper's order.
        scale: of our runs, such as "laptop: 8 views of 64x64, 240 steps".
        command: what made our numbers.
        sets: the paper's test set -> ours whose numbers stand beside it.
        protocols: those our metrics follow: "name", and a sentence for each metric that the runs
            state; several where runs differ.
        baselines: our test set -> baseline without a network -> PSNR.
        machine: the one that ours were measured on.
        folders: names of those that held the data of our runs.
        untested: the paper's test sets whose path no run was given.
    """

    paper: PaperTable
    rows: tuple[FilledRow, ...]
    scale: str
    command: str
    sets: dict[str, str] = field(default_factory=dict)
    protocols: tuple[dict[str, str], ...] = ()
    baselines: dict[str, dict[str, Number]] = field(default_factory=dict)
    machine: str = ""
    folders: tuple[str, ...] = ()
    untested: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        number = self.paper.number
        return (
            f"Ours: {self.paper.title}" if number is None else f"Table {number}: {self.paper.title}"
        )

    @property
    def networks(self) -> list[FilledRow]:
        """List the rows without post-optimization, which changes no cost of the network."""
        return [row for row in self.rows if row.paper.post_optimization == 0]

    def our_title(self, column: Column) -> str:
        """Return the title of our numbers: a set that stands for the paper's has its own name."""
        ours = self.sets.get(column.test_set, column.test_set)
        return column.title if ours == column.test_set else column.title_of(ours)

    @property
    def measured_columns(self) -> list[Column]:
        """List the columns that need a run."""
        return [column for column in self.paper.columns if column.key not in COMPUTED]


@dataclass(frozen=True)
class RankAgreement:
    """Whether our order of the rows follows the paper's.

    Args:
        rho: Spearman's; None below three rows, and where all rows are equal.
        rows: how many have both numbers.
        signal: standard deviation between the rows' means, over the one that such means of equal
            rows would have by their seeds alone: the root of the F statistic, about 1 where rows
            are equal. None where every row has a single seed.
    """

    rho: float | None
    rows: int
    signal: float | None


def mean_and_spread(values: Sequence[Number]) -> tuple[float, float | None]:
    """Return mean and sample standard deviation over seeds; None for that of a single seed."""
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return float(np.mean(values)), spread


def rank_agreement(filled: FilledTable, column: str) -> RankAgreement:
    """Compare the paper's numbers with our means in the column of this key."""
    both = [row for row in filled.rows if column in row.paper.numbers and row.values.get(column)]
    ours = np.array([np.mean(row.values[column]) for row in both])
    paper = np.array([row.paper.numbers[column] for row in both])
    between = float(np.std(ours, ddof=1)) if len(both) > 1 else None
    within = pooled_spread([row.values[column] for row in both])
    signal = None
    if between is not None and within is not None:
        seeds = float(np.mean([len(row.values[column]) for row in both]))
        signal = between / (within / math.sqrt(seeds)) if within else math.inf
    return RankAgreement(spearman(paper, ours), len(both), signal)


def spearman(first: np.ndarray, second: np.ndarray) -> float | None:
    """Return the correlation of the ranks; equal values share their mean rank.

    None below three values, and where either side is constant.
    """
    if len(first) < 3 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(spearmanr(first, second).statistic)


def pooled_spread(groups: Sequence[Sequence[Number]]) -> float | None:
    """Return the standard deviation within groups; None where each has a single value.

    Groups are weighted by their degrees of freedom.
    """
    freedom = sum(len(group) - 1 for group in groups)
    if freedom <= 0:
        return None
    squares = sum(float(np.var(group)) * len(group) for group in groups)
    return math.sqrt(squares / freedom)


def cost_errors(row: PaperRow, costs: Costs) -> dict[str, float]:
    """Return the relative error of each cost that has a limit and that the paper prints."""
    return {key: costs[key] / row.numbers[key] - 1 for key in LIMITS if key in row.numbers}


def fits(row: PaperRow, costs: Costs) -> bool:
    """Return whether every cost is within its limit of the paper's."""
    return all(abs(error) <= LIMITS[key] for key, error in cost_errors(row, costs).items())


def check(filled: FilledRow) -> str:
    """Judge a row's costs in a word; only a row whose architecture is known can be "off"."""
    if filled.paper.quoted:
        return "quoted"
    if filled.costs is None:
        return "not computed"
    if not cost_errors(filled.paper, filled.costs):
        return "not printed"
    fit = fits(filled.paper, filled.costs)
    if filled.paper.unverified:
        return "unverified, fits" if fit else "unverified, no fit"
    return "fits" if fit else "off"
