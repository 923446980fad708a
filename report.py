"""Write finished sweeps beside the paper's tables, or finished reconstructions as one page.

python report.py table=layers costs=true
python report.py runs=logs/reconstruct
"""

from collections.abc import Sequence
from pathlib import Path

from asysplat.cli import check_command, command

if __name__ == "__main__":
    check_command("report")

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.progress import track

from asysplat.files import atomic_write, make_folder
from asysplat.overrides import check_overrides
from asysplat.terminal import make_console
from paper.fill import fill_table, finished_runs, with_costs
from paper.html import render_html
from paper.markdown import render_markdown
from paper.reconstructions import report_reconstructions
from paper.systems import find_systems
from paper.tables import find_tables
from paper.terminal import render_terminal

OWN_OPTIONS = ("table", "costs", "overrides", "logs", "runs", "output")


@command("report")
def report(options: DictConfig) -> None:
    """Fill the tables, print them, write report.md and report.html; or the page of `runs`."""
    output = None if options.output is None else Path(str(options.output))
    if options.runs is not None:
        return report_reconstructions(Path(str(options.runs)), output)
    tables, logs = find_tables(options.table), Path(options.logs)
    folder = output or logs / "report"
    make_folder(folder, "output")
    overrides = [*sweep_overrides(HydraConfig.get().overrides.task), *options.overrides]
    check_overrides(overrides)
    runs, systems = finished_runs(logs), list(find_systems(logs))
    filled = [fill_table(table, overrides, compose_train, runs, systems) for table in tables]
    if options.costs:
        filled = [with_costs(table, compose_train) for table in track(filled, "counting costs")]
    console = make_console()
    render_terminal(filled, console)
    with atomic_write(folder / "report.md") as partial:
        partial.write_text(render_markdown(filled))
    with atomic_write(folder / "report.html") as partial:
        partial.write_text(render_html(filled))
    console.print(f"page: {folder / 'report.html'}", soft_wrap=True)


def sweep_overrides(overrides: Sequence[str]) -> list[str]:
    """Select the overrides of the command that are those of the sweeps."""
    return [override for override in overrides if override.partition("=")[0] not in OWN_OPTIONS]


def compose_train(overrides: Sequence[str]) -> DictConfig:
    """Compose the configuration that train.py would run."""
    return hydra.compose("train", list(overrides), return_hydra_config=True)


if __name__ == "__main__":
    report()
