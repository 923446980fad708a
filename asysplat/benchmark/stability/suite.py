"""Is anything not finite, or farther from float64 than rounding explains? One page says so."""

from collections.abc import Callable, Iterable
from itertools import chain

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from asysplat.benchmark.compare import ERROR, Watched
from asysplat.benchmark.options import check_names
from asysplat.benchmark.stability import (
    network,
    operators,
    prior,
    refinement,
    renderer,
    training,
)
from asysplat.benchmark.stability.judge import RULE, Case
from asysplat.benchmark.stability.page import page, plot, tables, verdict
from asysplat.benchmark.timing import Result
from asysplat.errors import InputError
from asysplat.overrides import check_overrides
from asysplat.training.revision import revision

AREAS: dict[str, Callable[[DictConfig], Iterable[Case]]] = {
    "operators": lambda wanted: chain(operators.cases(), prior.sweeps()),
    "prior": lambda wanted: prior.cases(wanted.views),
    "renderer": lambda wanted: renderer.cases(wanted.views),
    "network": lambda wanted: network.cases(wanted.models, wanted.overrides, wanted.views),
    "training": lambda wanted: training.cases(wanted.models, wanted.training_steps),
    "refinement": lambda wanted: refinement.cases(wanted.refinement_steps),
}

WATCHED = Watched(names=("area", "case", "precision"), alike=(), kinds={"error": ERROR})

__all__ = ["measure", "page", "plot", "tables", "verdict"]


def measure(options: DictConfig, console: Console) -> Result:
    """Measure every case of the areas `options.stability.areas`, on the CPU.

    Returns:
        "revision" of the code; "rule" of the tolerances; "rows": see `judge.line`, and "area",
        "case" and "precision".

    Raises:
        InputError: an unknown area or model, a number below 1.
    """
    wanted = options.stability
    check_names("stability.areas", wanted.areas, AREAS)
    check_overrides([f"model={model}" for model in wanted.models])
    _check_counts(wanted)
    cases = [case for area in wanted.areas for case in AREAS[area](wanted)]
    rows = [case.row() for case in track(cases, "cases", console=console)]
    return {"revision": revision(), "rule": RULE, "rows": rows}


def _check_counts(wanted: DictConfig) -> None:
    """Raise InputError unless views and steps are whole numbers from 1."""
    counts = {f"views={list(wanted.views)}": wanted.views}
    counts |= {f"{n}={wanted[n]}": [wanted[n]] for n in ("training_steps", "refinement_steps")}
    for said, values in counts.items():
        if not all(isinstance(value, int) and value >= 1 for value in values):
            raise InputError(f"stability.{said} cannot be: give whole numbers from 1.")
