"""Find what evaluate.py measured of other systems' scenes, and fill their rows with it."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from asysplat.files import read_json
from asysplat.runs.evaluation_target import SYSTEM, options_of_test
from asysplat.runs.runs import EVALUATION, Run, files_below
from asysplat.runs.summary import TESTED
from paper.notes import data_text
from paper.tables import Number, PaperRow, PaperTable

# Costs of refinements; other systems have none.
COSTS = {"inference_seconds": "cost/post0/seconds", "inference_gb": "cost/post0/gb"}


def find_systems(logs: Path) -> Iterator[Run]:
    """Yield every finished evaluation of another system below `logs`, oldest first."""
    for path in files_below(logs, EVALUATION):
        results = read_json(path)
        if SYSTEM in results:
            described = (
                results[f"evaluation/{key}"] for key in ("config_hash", "seed", "revision")
            )
            yield Run(path.parent, *described, results)


def system_rows(
    table: PaperTable, config: DictConfig, sets: Mapping[str, str], systems: Sequence[Run]
) -> tuple[list[PaperRow], list[Run]]:
    """Fill the quoted rows of a table; add a row for every other system that was measured as it is.

    A system has a row's name up to the first comma; case and signs do not count. Only a table that
    quotes a system gets further rows.

    Args:
        config: configuration of the table's runs: what is tested.
        sets: the paper's test sets -> ours.
        systems: evaluations, oldest first.

    Returns:
        The table's rows, those of runs unchanged, and the evaluations that were used.
    """
    names = {_letters(row.name) for row in table.rows if row.quoted}
    others = {_letters(run.results[SYSTEM]): run.results[SYSTEM] for run in systems}
    further = [
        PaperRow(label, {}, None, table.rows[0].views, table.rows[0].size)
        for key, label in others.items()
        if names and key not in names
    ]
    rows, used = [], []
    for row in (*table.rows, *further):
        if row.quoted:
            own = [run for run in systems if _letters(run.results[SYSTEM]) == _letters(row.name)]
            row, agreeing = _fill(row, table, config, sets, own)
            used += agreeing
        if row.values or row.numbers or not row.quoted:
            rows.append(row)
    return rows, used


def _fill(
    row: PaperRow,
    table: PaperTable,
    config: DictConfig,
    sets: Mapping[str, str],
    systems: Sequence[Run],
) -> tuple[PaperRow, list[Run]]:
    """Fill a row with a system's evaluations; where none agrees with the table, note why."""
    values: dict[str, list[Number]] = {}
    used: list[Run] = []
    unlike = ""
    for column in table.columns:
        paper_set, _, metric = column.key.partition("/")
        wanted = options_of_test(config, row.test_set or sets.get(paper_set, config.data.name))
        key = f"test/{wanted['data']}/post0/{metric}" if metric else COSTS.get(column.key)
        newest: dict[int, Run] = {}  # by seed
        for run in systems:
            of_run = {key: run.results.get(f"{TESTED}{key}", wanted[key]) for key in wanted}
            if others := [f"{k}={v} ({wanted[k]})" for k, v in of_run.items() if v != wanted[k]]:
                unlike = f"measured with other options than the table's (in brackets): {run.folder}"
                unlike += f" has {', '.join(others)}"
            elif key is not None and run.results.get(key) is not None:
                newest[run.seed] = run
        runs = [newest[seed] for seed in sorted(newest)]
        if runs:
            values[column.key] = [run.results[key] for run in runs]
        used += [run for run in runs if run not in used]
    if not used:
        return replace(row, note=unlike), []
    note = "measured: " + "; ".join(dict.fromkeys(map(_describe, used)))
    note += "; the paper's numbers are quoted" * bool(row.numbers)
    seeds = tuple(sorted({run.seed for run in used}))
    revisions = tuple(sorted({run.revision for run in used}))
    return replace(row, values=values, seeds=seeds, revisions=revisions, note=note), used


def _describe(run: Run) -> str:
    """Write what an evaluation was made on."""
    tested = {k.removeprefix(TESTED): v for k, v in run.results.items() if k.startswith(TESTED)}
    text = f"{tested['scenes']} scenes of {data_text(tested['data'], tested.get('places'))}, "
    text += f"{tested['inputs']} input views of {tested['height']}x{tested['width']}, "
    text += f"metrics {tested['metrics.name']}, seed {run.seed}, {run.folder}"
    if "cost/post0/steps" in run.results:
        steps, seconds = (run.results[f"cost/post0/{name}"] for name in ("steps", "seconds"))
        text = f"{steps:,.0f} steps in {seconds:.0f} s, {text}"
    if "residual" in tested:
        text += f", cameras fitted with a residual of {tested['residual']:.1%} at most"
    return text


def _letters(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.partition(",")[0].lower())
