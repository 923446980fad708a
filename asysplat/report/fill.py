"""The paper's tables filled with our numbers: from finished runs, and costs without any."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from asysplat.evaluation.static_cost import static_costs
from asysplat.report.filled import Costs, FilledRow, FilledTable, Number
from asysplat.report.paper import Row, Table, set_titles, stand_ins
from asysplat.training.runs import Run, find_runs, identity

# Overrides of train.py -> its configuration, the node `hydra` included.
Compose = Callable[[Sequence[str]], DictConfig]
Runs = dict[str, dict[int, Run]]  # by identity and seed

BASELINES = ("mean_colour", "nearest_view")
# Columns that every run measures in passing, as it calls them, without and with post-optimisation.
MEASURED = {
    "seconds_per_step": ("cost/seconds_per_step", None),
    "train_gb": ("cost/peak_gb", None),
    "inference_seconds": ("cost/inference_seconds", "cost/post{}/seconds"),
    "inference_gb": ("cost/inference_gb", "cost/post{}/gb"),
}
# Columns that are settings of a run.
SETTINGS = {"batch": "data.batch_size", "train_steps": "steps"}


def finished_runs(logs: Path) -> Runs:
    """All of them; of equal ones the newest."""
    runs: Runs = {}
    for run in find_runs(logs):
        runs.setdefault(run.identity, {})[run.seed] = run
    return runs


def fill_table(table: Table, words: Sequence[str], compose: Compose, runs: Runs) -> FilledTable:
    """The table with every finished run whose configuration is that of a row of its sweep.

    Args:
        table: the paper's.
        words: of the command that the sweep was started with, but for `sweeps=`.
        compose: train.py's configuration.
        runs: to look among.

    Raises:
        InputError: a data set without stand-ins for the paper's.
    """
    words = [f"sweeps={table.key}", *words]
    config = compose(words)
    sets = stand_ins(config.data.name)
    seeds = str(config.hydra.sweeper.params.get("seed", config.seed))
    wanted = [int(seed) for seed in seeds.split(",")]
    rows, found = [], []
    for row in table.rows:
        if row.quoted:
            rows.append(FilledRow(row))
            continue
        row_config = _task(compose([*words, *row.run]))
        same = runs.get(identity(row_config), {})
        found += same.values()
        rows.append(_measured_row(row, table, row_config, same, wanted, sets))
    return FilledTable(
        table,
        tuple(rows),
        scale=_scale_text(config),
        command=f"python train.py {' '.join(words)}",
        stand_ins=_stand_ins_text(table, sets),
        baselines=_baselines(table, sets, found),
        machine=", ".join(sorted({run.results.get("run/machine", "") for run in found})),
    )


def with_costs(filled: FilledTable, compose: Compose) -> FilledTable:
    """The table with every row's costs at the paper's scale, other readings included."""

    def costs(run: tuple[str, ...], row: Row) -> Costs:
        return _costs(compose, run, row.views, row.size)

    rows = [
        row
        if row.row.quoted or row.row.post_optimisation
        else replace(
            row,
            costs=costs(row.row.run, row.row),
            reading_costs=tuple(costs(reading.run, row.row) for reading in row.row.readings),
        )
        for row in filled.rows
    ]
    return replace(filled, rows=tuple(rows))


@cache
def _costs(compose: Compose, run: tuple[str, ...], views: int, size: tuple[int, int]) -> Costs:
    config = compose([*run, "scale=paper"])
    with torch.device("meta"):
        net = instantiate(config.model)
    return static_costs(net, views, *size)


def _task(config: DictConfig) -> DictConfig:
    """What the run itself is given."""
    return OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])


def _measured_row(
    row: Row,
    table: Table,
    config: DictConfig,
    runs: dict[int, Run],
    wanted: Sequence[int],
    sets: dict[str, str],
) -> FilledRow:
    values: dict[str, list[Number]] = {}
    for column in table.columns:
        if column.key in SETTINGS and runs:
            values[column.key] = [OmegaConf.select(config, SETTINGS[column.key])]
            continue
        key = _result_key(column.key, row, sets)
        numbers = [runs[seed].results.get(key) for seed in sorted(runs)]
        present = [number for number in numbers if number is not None]
        if present:
            values[column.key] = present
    return FilledRow(
        row,
        values=values,
        seeds=tuple(sorted(runs)) if values else (),
        missing=tuple(seed for seed in wanted if seed not in runs),
        note=_note(row, values, runs, wanted),
    )


def _result_key(column: str, row: Row, sets: dict[str, str]) -> str | None:
    """What metrics.json and evaluation.json call the number; None where no run measures it."""
    steps = row.post_optimisation
    if column in MEASURED:
        plain, optimised = MEASURED[column]
        return optimised and optimised.format(steps) if steps else plain
    paper_set, _, metric = column.partition("/")
    ours = row.test_set or sets.get(paper_set)
    if not metric or ours is None:
        return None
    return f"test/{ours}/post{steps}/{metric}" if steps else f"test/{ours}/{metric}"


def _note(
    row: Row, values: dict[str, list[Number]], runs: dict[int, Run], wanted: Sequence[int]
) -> str:
    if row.post_optimisation and not values:
        return "not run: needs post-optimisation of a trained model (evaluate.py)"
    missing = [str(seed) for seed in wanted if seed not in runs]
    if values and missing:
        return f"seeds still to run: {', '.join(missing)}"
    return ""


def _scale_text(config: DictConfig) -> str:
    data = config.data
    return (
        f"{data.name} data, {data.inputs} input views of {data.height}x{data.width}, "
        f"{config.steps} steps of batch {data.batch_size}, {config.width:g} of the paper's width"
    )


def _stand_ins_text(table: Table, sets: dict[str, str]) -> str:
    used = [key for key in _paper_sets(table) if sets.get(key, key) != key]
    pairs = [f"{set_titles()[key]} by our test set {sets[key]}" for key in used]
    return "; ".join(pairs)


def _baselines(
    table: Table, sets: dict[str, str], runs: Sequence[Run]
) -> dict[str, dict[str, Number]]:
    """Per test set of ours: the same in every run that was tested on it."""
    found: dict[str, dict[str, Number]] = {}
    for name in dict.fromkeys(sets[key] for key in _paper_sets(table) if key in sets):
        for run in runs:
            keys = {baseline: f"baseline/{name}/{baseline}/psnr" for baseline in BASELINES}
            if all(key in run.results for key in keys.values()):
                found[name] = {baseline: run.results[key] for baseline, key in keys.items()}
    return found


def _paper_sets(table: Table) -> list[str]:
    """The test sets of its columns, in order."""
    keys = [column.key.partition("/") for column in table.columns]
    return list(dict.fromkeys(test_set for test_set, slash, _ in keys if slash))
