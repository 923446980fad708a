"""Fill the paper's tables with our numbers: those of finished runs, and costs, which need none."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from asysplat.evaluation.measured_cost import PEAK_MEMORY
from asysplat.evaluation.metrics import BASELINES
from asysplat.evaluation.static_cost import static_costs
from asysplat.runs.run_config import plain_options
from asysplat.runs.runs import CHOICES, Run, config_hash, data_of, differences, find_runs
from asysplat.runs.stages import describe_stage, stage_configs
from paper.notes import data_text, rows_by_text
from paper.systems import system_rows
from paper.tables import (
    Costs,
    Number,
    PaperRow,
    PaperTable,
    load_paper,
    our_sets,
    set_titles,
    stage_hours,
)

# Overrides of train.py -> its configuration, the node `hydra` included.
Compose = Callable[[Sequence[str]], DictConfig]
Runs = dict[str, list[Run]]  # by config_hash, oldest first

# Columns that every run measures: their keys in metrics.json, without and with post-optimization.
MEASURED = {
    "seconds_per_step": ("cost/seconds_per_step", None),
    "train_gb": ("cost/peak_gb", None),
    "inference_seconds": ("cost/inference_seconds", "cost/post{}/seconds"),
    "inference_gb": ("cost/inference_gb", "cost/post{}/gb"),
}
SIMILAR = 16  # options, at most, that the run named beside a row without one may have differently
# Columns that are options of a run.
OPTIONS = {"batch": "data.batch_size", "train_steps": "steps"}
# Columns that need no run: they are printed with the costs, at the paper's scale.
COMPUTED = ("parameters", "gflops", "gflops_true", "gaussians")


def finished_runs(logs: Path) -> Runs:
    """Find all finished runs below a folder."""
    runs: Runs = {}
    for run in find_runs(logs):
        runs.setdefault(run.config_hash, []).append(run)
    return runs


def fill_table(
    table: PaperTable,
    overrides: Sequence[str],
    compose: Compose,
    runs: Runs,
    systems: Sequence[Run] = (),
) -> PaperTable:
    """Fill a table with every finished run that has the configuration of one of its rows.

    Args:
        table: table of the paper.
        overrides: options of the command that started the sweep, without `sweeps=`. Paths may be
            left out; a given path must have the same name as the run's.
        compose: returns train.py's configuration.
        runs: finished runs to select from.
        systems: evaluations of other systems, see `system_rows`.
    """
    if table.claims:
        return _fill_claims(table, overrides, compose, runs, systems)
    overrides = [f"sweeps={table.key}", *overrides]
    config = compose(overrides)
    sets = our_sets(table, config.data.name, config.data.test_sets or ())
    seeds = str(config.hydra.sweeper.params.get("seed", config.seed)).split(",")
    rows: list[PaperRow] = []
    heads: dict[str, list[str]] = {}  # head -> labels of its rows
    given, used = system_rows(table, config, sets, systems)
    for row in given:
        if row.quoted:
            rows.append(row)
            continue
        row_config, same_options, row_runs = _runs_of(compose([*overrides, *row.run]), runs)
        note, options = ("", ()) if row_runs else _nearest_run(row_config, same_options, runs)
        if row.also and not row_runs:
            also = _runs_of(compose([*overrides, *row.run, *row.also]), runs)
            if also[-1]:
                row_config, same_options, row_runs = also
                note, options = f"runs with {' '.join(row.also)}", ()
        used += row_runs.values()
        heads.setdefault(_head(row_config), []).append(row.label)
        values: dict[str, list[Number]] = {}
        for column in table.columns:
            if column.key in OPTIONS:
                numbers = [OmegaConf.select(row_config, OPTIONS[column.key])] if row_runs else []
            elif (
                column.key == "train_hours"
            ):  # hours of the whole stage, of which the runs are a part
                steps = row_config.stages[row_config.stage].steps
                numbers = [stage_hours(steps, s) for s in values.get("seconds_per_step", ())]
            else:
                key = _result_key(column.key, row, sets)
                numbers = [row_runs[seed].results.get(key) for seed in sorted(row_runs)]
                numbers = [number for number in numbers if number is not None]
            if numbers:
                values[column.key] = numbers
        missing = ", ".join(str(seed) for seed in map(int, seeds) if seed not in row_runs)
        if values and missing:
            note = "; ".join(filter(None, (note, f"seeds still to run: {missing}")))
        if row.post_optimization and not values:
            note = "not run: python evaluate.py run=... adds post-optimization to a finished run"
            options = ()
        row = replace(row, values=values, note=note, options=options)
        if values:
            revisions = tuple(sorted({run.revision for run in row_runs.values()}))
            folders = tuple(str(row_runs[seed].folder) for seed in sorted(row_runs))
            row = replace(row, seeds=tuple(sorted(row_runs)), folders=folders, revisions=revisions)
        rows.append(row)
    data = config.data
    height, width = data.test_size or (data.height, data.width)
    stages = ", then ".join(describe_stage(stage) for stage in stage_configs(config))
    notes = {
        "Ours": f"{data_text(data.name, data.get('places'))}, {data.inputs} input views of "
        f"{height}x{width}, {stages}, {config.width:g} of the paper's width",
        "Head": rows_by_text(heads),
        "Not tested": _untested(sets, config, rows),
        "Baselines": _baselines(sets, used),
        "Data": _folders(used),
        "Machine": ", ".join(sorted({run.results.get("run/machine", "") for run in used} - {""})),
        "Command": f"python train.py {' '.join(overrides)}",
    }
    metrics, memory = _metrics(table, config, used), _memory(config, used)
    rows = tuple(rows)
    return replace(table, rows=rows, sets=sets, memory=memory, metrics=metrics, notes=notes)


def _fill_claims(
    table: PaperTable,
    overrides: Sequence[str],
    compose: Compose,
    runs: Runs,
    systems: Sequence[Run],
) -> PaperTable:
    """Fill the rows of claims as those of their tables."""
    keys = dict.fromkeys(claim.table for claim in table.claims)
    tables = {key: fill_table(load_paper()[key], overrides, compose, runs, systems) for key in keys}
    claims = []
    for claim in table.claims:
        rows = {row.name: row for row in tables[claim.table].rows}
        sides = tuple(tuple(rows[row.name] for row in side) for side in claim.rows)
        claims.append(replace(claim, rows=sides))

    def joined(label: str, by: str) -> str:
        texts = dict.fromkeys(filled.notes[label] for filled in tables.values())
        return by.join(filter(None, texts))

    config = compose(overrides)
    notes = {
        "Ours": f"counts at the paper's scale; seconds and hours on {config.data.name} data, "
        f"{config.data.inputs} input views, {config.width:g} of the paper's width",
        "Head": joined("Head", "; "),
        "Machine": joined("Machine", "; "),
        "Command": joined("Command", " && "),
    }
    return replace(table, claims=tuple(claims), notes=notes)


def _runs_of(config: DictConfig, runs: Runs) -> tuple[DictConfig, list[Run], dict[int, Run]]:
    """Return a row's configuration, all runs with its options, and those on its data by seed.

    For each seed that is the newest run, first among those tested on all of the data.
    """
    config = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
    read = data_of(config)
    same_options = runs.get(config_hash(config), [])
    same = [run for run in same_options if run.is_consistent_with(read)]
    by_seed = {run.seed: run for run in sorted(same, key=lambda run: run.covers(read))}
    return config, same_options, by_seed


def _nearest_run(
    config: DictConfig, same_options: Sequence[Run], runs: Runs
) -> tuple[str, tuple[str, ...]]:
    """Write why the run that is most like a row is not the row's, and the options that differ.

    Both are empty without one like it. The choices that a run logs are first, then its model's.
    """
    if same_options:
        return f"not run on this data: on other data: {same_options[-1].folder}", ()
    unlike = [(differences(found[-1], config), found[-1].folder) for found in runs.values()]
    unlike = [(options, folder) for options, folder in unlike if 0 < len(options) <= SIMILAR]
    if not unlike:
        return "", ()
    options, folder = min(unlike, key=lambda each: len(each[0]))
    keys = sorted(options, key=lambda key: (key not in CHOICES, not key.startswith("model.")))
    texts = [f"{key}={options[key][0]} ({options[key][1]})" for key in keys]
    return f"not run: {folder} has other options than the row (in brackets)", tuple(texts)


def with_costs(filled: PaperTable, compose: Compose) -> PaperTable:
    """Add the costs of every row and its other readings at the paper's scale."""
    claims = []
    for claim in filled.claims:
        if claim.column.key in COMPUTED:
            sides = (tuple(_row_with_costs(row, compose) for row in side) for side in claim.rows)
            claim = replace(claim, rows=tuple(sides))
        claims.append(claim)
    rows = tuple(_row_with_costs(row, compose) for row in filled.rows)
    return replace(filled, rows=rows, claims=tuple(claims))


def _row_with_costs(row: PaperRow, compose: Compose) -> PaperRow:
    if row.quoted or row.post_optimization:
        return row
    runs = (row.run, *row.readings.values())
    own, *readings = (_costs(compose, run, row.views, row.size) for run in runs)
    return replace(row, costs=own, reading_costs=tuple(readings))


@cache
def _costs(compose: Compose, run: tuple[str, ...], views: int, size: tuple[int, int]) -> Costs:
    config = compose([*run, "scale=paper"])
    with torch.device("meta"):
        net = instantiate(config.model)
    return static_costs(net, views, *size)


def _head(config: DictConfig) -> str:
    """Write the head of a model and its options, as `ResidualHead(sh_degree=3)`."""
    head = plain_options(config.model).get("head")
    if head is None:
        return "the model's own"
    options = (f"{key}={value}" for key, value in head.items() if not key.startswith("_"))
    return f"{head['_target_'].rpartition('.')[-1]}({', '.join(options)})"


def _result_key(column: str, row: PaperRow, sets: dict[str, str]) -> str | None:
    """Return the key of a number in metrics.json or evaluation.json; None if no run has it."""
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


def _metrics(table: PaperTable, config: DictConfig, runs: Sequence[Run]) -> tuple[str, ...]:
    """Describe the metrics of the table in each run's protocol, or why it has none; name it."""
    kinds = {column.key.rpartition("/")[-1]: column.kind for column in table.columns}
    texts = []
    for results in [run.results for run in runs] or [{}]:
        keys = [key.split("/") for key in results]
        said = {key[1]: results["/".join(key)] for key in keys if key[0] in ("protocol", "missing")}
        sentences = [f"{kinds[kind]}: {text}" for kind, text in said.items() if kind in kinds]
        name = said.get("name", config.metrics.name)
        texts.append(". ".join([f"protocol {name}", *sentences]))
    return tuple(dict.fromkeys(texts))


def _memory(config: DictConfig, runs: Sequence[Run]) -> str:
    """Write what the runs' memory is: that of the process, or of a GPU's tensors."""
    machines = [run.results.get("run/machine", "") for run in runs]
    on_cpu = {config.trainer.accelerator == "cpu" or "CPU" in name for name in machines if name}
    return " or ".join(PEAK_MEMORY["cpu" if cpu else "cuda"] for cpu in sorted(on_cpu))


def _baselines(sets: dict[str, str], runs: Sequence[Run]) -> str:
    """Write the PSNR of each test set's baselines, the same in every run tested on it."""
    texts = {}
    for name in dict.fromkeys(sets.values()):
        for run in runs:
            psnrs = {k: run.results.get(f"baseline/{name}/{k}/psnr") for k in BASELINES}
            if None not in psnrs.values():
                numbers = (f"{BASELINES[k][0]} {psnr:.2f} dB" for k, psnr in psnrs.items())
                texts[name] = f"{name}: {', '.join(numbers)}"
    return "; ".join(texts.values())


def _folders(runs: Sequence[Run]) -> str:
    keys = ("run/data/root", "run/data/test_root")
    of_runs = {" and ".join(run.results[k] for k in keys if k in run.results) for run in runs}
    folders = sorted(of_runs - {""})
    mixed = "runs on several are mixed, name one with data.root=... in overrides: "
    return mixed * (len(folders) > 1) + "; ".join(folders)


def _untested(sets: dict[str, str], config: DictConfig, rows: Sequence[PaperRow]) -> str:
    """List the paper's test sets that the sweep names without a path, and no row has numbers of."""
    tested = {key.partition("/")[0] for row in rows for key in row.values}
    data = plain_options(config.data)
    if "root" not in data:  # synthetic data has no test sets on disk
        return ""
    no_path = [name for name, how in data["test_sets"].items() if how.get("root", "") is None]
    untested = [key for key, ours in sets.items() if ours in no_path and key not in tested]
    return "; ".join(f"{set_titles()[key]}, without paths.{key}=..." for key in untested)
