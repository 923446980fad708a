"""Print a table at the end of a sweep."""

import atexit
from collections.abc import Sequence
from pathlib import Path

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from rich.table import Column, Table

from asysplat.evaluation.metrics import METRICS
from asysplat.runs.runs import Run, find_run
from asysplat.runs.summary import BASELINE_ROWS, metric_cells, missing_metrics
from asysplat.terminal import make_console

Job = tuple[dict[str, str], DictConfig, Run | None]  # overrides, configuration, its finished run


class SweepTable(Callback):
    """Prints the jobs of a sweep after the last: the options that vary and the test's metrics."""

    def __init__(self):
        self.complete = False

    def on_multirun_start(self, config: DictConfig, **_: object) -> None:
        # on_multirun_end is not called if a job fails
        atexit.register(self._print, config)

    def on_multirun_end(self, config: DictConfig, **_: object) -> None:
        self.complete = True

    def _print(self, config: DictConfig) -> None:
        jobs = read_jobs(Path(config.hydra.sweep.dir), Path(config.paths.logs))
        if any(run is not None for *_, run in jobs):
            make_console().print(sweep_table(jobs))
        if jobs and not self.complete:
            print("The sweep is not finished: the same command skips the jobs that are.")


def read_jobs(folder: Path, logs: Path) -> list[Job]:
    """Read the jobs of the sweep in `folder`, in their order, and find their runs below `logs`."""
    jobs = []
    for path in sorted(folder.glob("*/.hydra"), key=_number):
        words = [str(word).partition("=") for word in OmegaConf.load(path / "overrides.yaml")]
        config = DictConfig(OmegaConf.load(path / "config.yaml"))
        jobs.append(({key: value for key, _, value in words}, config, find_run(logs, config)))
    return jobs


def _number(path: Path) -> int:
    return int(path.parent.name.partition("_")[0])


def sweep_table(jobs: Sequence[Job]) -> Table:
    """Make a table of the jobs, and of the baselines if all jobs were tested on the same scenes."""
    keys = dict.fromkeys(key for overrides, *_ in jobs for key in overrides)
    varied = [key for key in keys if len({overrides.get(key) for overrides, *_ in jobs}) > 1]
    names = sorted({config.data.name for _, config, _ in jobs})
    protocols = sorted({config.metrics.name for _, config, _ in jobs})
    title = f"test scenes: {', '.join(names)}, metrics: {', '.join(protocols)}"
    headings = (*varied, "size", "geometry", *METRICS.values())
    table = Table(*(Column(heading, overflow="fold") for heading in headings), title=title)
    for overrides, config, run in jobs:
        results = {} if run is None else run.results
        size = "not finished" if run is None else ""
        if "cost/parameters" in results:
            size = f"{results['cost/parameters'] / 1e6:.2f}M"
        fraction = results.get("cost/geometry_ratio")
        table.add_row(
            *(overrides.get(key, "") for key in varied),
            size,
            "" if fraction is None else f"{fraction:.1%}",
            *metric_cells(results, f"test/{config.data.name}"),
        )
    results_of_runs = [run.results for *_, run in jobs if run is not None]
    for label, prefix in BASELINE_ROWS.items() if len(names) == 1 else ():
        space = [""] * (len(varied) + 1)
        cells = metric_cells(results_of_runs[-1], prefix.format(names[0]))
        if any(cells):
            table.add_row(label, *space, *cells)
    sentences = [text for results in results_of_runs for text in missing_metrics(results)]
    table.caption = "\n".join(dict.fromkeys(sentences))
    return table
