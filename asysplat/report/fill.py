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
from asysplat.report.paper import PaperRow, PaperTable, our_sets
from asysplat.training.runs import Run, config_hash, data_of, find_runs
from asysplat.training.stages import describe_stage, stage_configs

# Overrides of train.py -> its configuration, the node `hydra` included.
Compose = Callable[[Sequence[str]], DictConfig]
Runs = dict[str, list[Run]]  # by config_hash, oldest first

BASELINES = ("mean_color", "nearest_view")
# Columns that every run measures: their keys in metrics.json, without and with post-optimization.
MEASURED = {
    "seconds_per_step": ("cost/seconds_per_step", None),
    "train_gb": ("cost/peak_gb", None),
    "inference_seconds": ("cost/inference_seconds", "cost/post{}/seconds"),
    "inference_gb": ("cost/inference_gb", "cost/post{}/gb"),
}
# Columns that are settings of a run.
SETTINGS = {"batch": "data.batch_size", "train_steps": "steps"}


def finished_runs(logs: Path) -> Runs:
    """Find all finished runs below a folder, by the hash of their configuration."""
    runs: Runs = {}
    for run in find_runs(logs):
        runs.setdefault(run.config_hash, []).append(run)
    return runs


def fill_table(
    table: PaperTable, overrides: Sequence[str], compose: Compose, runs: Runs
) -> FilledTable:
    """Fill a table with every finished run whose configuration is that of a row of its sweep.

    Args:
        table: the paper's.
        overrides: of the command that started the sweep, but for `sweeps=`. Paths may be left out;
            a path that is given must have the name of the run's.
        compose: gives train.py's configuration.
        runs: those to look among.
    """
    overrides = [f"sweeps={table.key}", *overrides]
    config = compose(overrides)
    sets = our_sets(table, config.data.name, config.data.test_sets or ())
    seeds = str(config.hydra.sweeper.params.get("seed", config.seed))
    wanted = [int(seed) for seed in seeds.split(",")]
    rows: list[FilledRow] = []
    found: list[Run] = []
    for row in table.rows:
        if row.quoted:
            rows.append(FilledRow(row))
            continue
        row_config = _without_hydra(compose([*overrides, *row.run]))
        same = _runs_of(row_config, runs)
        found += same.values()
        rows.append(_measured_row(row, table, row_config, same, wanted, sets))
    return FilledTable(
        table,
        tuple(rows),
        scale=_scale_text(config),
        command=f"python train.py {' '.join(overrides)}",
        sets=sets,
        protocols=_protocols(found, config.metrics.name),
        baselines=_baselines(sets, found),
        machine=", ".join(sorted({run.results.get("run/machine", "") for run in found})),
        folders=tuple(sorted({_folders(run) for run in found} - {""})),
        untested=_untested(sets, config, rows),
    )


def with_costs(filled: FilledTable, compose: Compose) -> FilledTable:
    """Add every row's costs at the paper's scale, those of other readings included."""

    def costs(run: tuple[str, ...], row: PaperRow) -> Costs:
        return _costs(compose, run, row.views, row.size)

    rows = [
        row
        if row.paper.quoted or row.paper.post_optimization
        else replace(
            row,
            costs=costs(row.paper.run, row.paper),
            reading_costs=tuple(costs(reading.run, row.paper) for reading in row.paper.readings),
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


def _runs_of(config: DictConfig, runs: Runs) -> dict[int, Run]:
    """Find a run for each seed: of several the newest that was tested on all of the data."""
    data = data_of(config)
    same = [run for run in runs.get(config_hash(config), []) if run.agrees(data)]
    return {run.seed: run for run in sorted(same, key=lambda run: run.covers(data))}


def _without_hydra(config: DictConfig) -> DictConfig:
    """Return the configuration that the run itself is given."""
    return OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])


def _measured_row(
    row: PaperRow,
    table: PaperTable,
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
        revisions=tuple(sorted({run.revision for run in runs.values()})) if values else (),
        missing=tuple(seed for seed in wanted if seed not in runs),
        note=_note(row, values, runs, wanted),
    )


def _result_key(column: str, row: PaperRow, sets: dict[str, str]) -> str | None:
    """Return the key of a number in metrics.json or evaluation.json; None where no run has it."""
    steps = row.post_optimization
    if column in MEASURED:
        plain, optimized = MEASURED[column]
        if steps:
            return optimized and optimized.format(steps)
        return plain.replace("cost/", f"cost/{row.test_set}/") if row.test_set else plain
    paper_set, _, metric = column.partition("/")
    if not metric:
        return None
    ours = row.test_set or sets[paper_set]
    return f"test/{ours}/post{steps}/{metric}" if steps else f"test/{ours}/{metric}"


def _note(
    row: PaperRow, values: dict[str, list[Number]], runs: dict[int, Run], wanted: Sequence[int]
) -> str:
    if row.post_optimization and not values:
        return "not run: python evaluate.py run=... adds post-optimization to a finished run"
    missing = [str(seed) for seed in wanted if seed not in runs]
    if values and missing:
        return f"seeds still to run: {', '.join(missing)}"
    return ""


def _scale_text(config: DictConfig) -> str:
    data = config.data
    height, width = data.test_size or (data.height, data.width)
    stages = ", then ".join(describe_stage(stage) for stage in stage_configs(config))
    return (
        f"{data.name} data, {data.inputs} input views of {height}x{width}, {stages}, "
        f"{config.width:g} of the paper's width"
    )


def _protocols(runs: Sequence[Run], name: str) -> tuple[dict[str, str], ...]:
    """List the protocols that runs state, each once; without a run the configuration's name."""
    stated: list[dict[str, str]] = []
    for run in runs:
        keys = [key for key in run.results if key.startswith("protocol/")]
        one = {"name": name} | {key.partition("/")[2]: run.results[key] for key in keys}
        if one not in stated:
            stated.append(one)
    return tuple(stated) or ({"name": name},)


def _baselines(sets: dict[str, str], runs: Sequence[Run]) -> dict[str, dict[str, Number]]:
    """Find the baselines of each test set, the same in every run that was tested on it."""
    found: dict[str, dict[str, Number]] = {}
    for name in dict.fromkeys(sets.values()):
        for run in runs:
            keys = {baseline: f"baseline/{name}/{baseline}/psnr" for baseline in BASELINES}
            if all(key in run.results for key in keys.values()):
                found[name] = {baseline: run.results[key] for baseline, key in keys.items()}
    return found


def _folders(run: Run) -> str:
    keys = ("run/data/root", "run/data/test_root")
    return " and ".join(run.results[key] for key in keys if key in run.results)


def _untested(
    sets: dict[str, str], config: DictConfig, rows: Sequence[FilledRow]
) -> tuple[str, ...]:
    """Find the paper's test sets that the sweep names but has no path of, and no row numbers of."""
    measured = {key.partition("/")[0] for row in rows for key in row.values}
    data = OmegaConf.to_container(config.data, resolve=True)
    if "root" not in data:  # synthetic data, which tests none on disk
        return ()
    lacking = [name for name, how in data["test_sets"].items() if how.get("root", "") is None]
    return tuple(key for key, ours in sets.items() if ours in lacking and key not in measured)
