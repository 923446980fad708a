"""Write finished sweeps beside the paper's tables, reconstructions as a page, or a figure.

python report.py table=layers costs=true
python report.py runs=logs/reconstruct
python report.py images=[ours,3dgs]
python report.py network=asysplat_4m4s scale=paper
"""

from collections.abc import Sequence
from pathlib import Path

from asysplat.cli import check_command, command

if __name__ == "__main__":
    check_command("report")

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig, ListConfig
from rich.progress import track

from asysplat.files import atomic_write, make_folder
from asysplat.overrides import check_overrides
from asysplat.terminal import make_console
from paper.comparison import draw_views, read_views
from paper.fill import fill_table, finished_runs, with_costs
from paper.html import render_html
from paper.markdown import render_markdown
from paper.network import draw_network
from paper.reconstructions import report_reconstructions
from paper.systems import find_systems
from paper.tables import find_tables
from paper.terminal import render_terminal

OWN_OPTIONS = ("table", "costs", "overrides", "logs", "runs", "output")
OWN_OPTIONS += ("images", "scenes", "views", "network")  # of figures


@command("report")
def report(options: DictConfig) -> None:
    """Fill the tables, print and write them; or the page of `runs`, or a figure."""
    output = None if options.output is None else Path(str(options.output))
    if options.runs is not None:
        return report_reconstructions(Path(str(options.runs)), output)
    logs = Path(options.logs)
    folder = output or logs / "report"
    if options.images:
        return report_images(options, folder)
    overrides = [*sweep_overrides(HydraConfig.get().overrides.task), *options.overrides]
    overrides += [f"model={options.network}"] if options.network else []
    check_overrides(overrides)
    if options.network:
        return report_network(compose_train(overrides), folder)
    tables = find_tables(options.table)
    make_folder(folder, "output")
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


def report_images(options: DictConfig, folder: Path) -> None:
    """Draw test views of several systems side by side, comparison.png."""
    images, scenes, views = (
        list(map(str, value if isinstance(value, ListConfig) else [value])) if value else []
        for value in (options.images, options.scenes, options.views)
    )
    save_figure(
        draw_views(read_views(list(map(Path, images)), scenes, views)), folder, "comparison"
    )


def report_network(config: DictConfig, folder: Path) -> None:
    """Draw the network of a configuration of train.py, network.png."""
    with torch.device("meta"):
        net = instantiate(config.model)
    data = config.data
    save_figure(draw_network(net, data.inputs, data.height, data.width), folder, "network")


def save_figure(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as a PNG, and print where it is."""
    make_folder(folder, "output")
    with atomic_write(folder / f"{name}.png") as partial:
        figure.savefig(partial, dpi=200, bbox_inches="tight")
    make_console().print(f"figure: {folder / f'{name}.png'}", soft_wrap=True)


def sweep_overrides(overrides: Sequence[str]) -> list[str]:
    """Select the overrides of the command that are those of the sweeps."""
    return [override for override in overrides if override.partition("=")[0] not in OWN_OPTIONS]


def compose_train(overrides: Sequence[str]) -> DictConfig:
    """Compose the configuration that train.py would run."""
    return hydra.compose("train", list(overrides), return_hydra_config=True)


if __name__ == "__main__":
    report()
