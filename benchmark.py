"""Time against error, and quality against seconds, in one process.

python benchmark.py suite=render scenes=[A,C]
"""

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read with torch: who waits must not spin

import hydra
from omegaconf import DictConfig
from rich.console import Console

from asysplat.benchmark.machine import describe_machine
from asysplat.benchmark.options import check_repeats, find_suite
from asysplat.errors import input_error_behind
from asysplat.overrides import exit_at_unknown_overrides


@hydra.main(config_path="conf", config_name="benchmark", version_base="1.3")
def main(options: DictConfig) -> None:
    try:
        benchmark(options)
    except Exception as error:
        known = input_error_behind(error)
        if known is None:
            raise
        sys.exit(f"error: {known}")


def benchmark(options: DictConfig) -> None:
    """Measure, print the tables, write <suite>.json, <suite>.png and, if it has one, its page."""
    suite = find_suite(options.suite)
    check_repeats(options.repeats)
    console = Console()
    results = {"machine": describe_machine(), **suite.measure(options, console)}
    for table in suite.tables(results):
        console.print(table)
    folder = Path(options.output)
    folder.mkdir(parents=True, exist_ok=True)
    numbers, picture = (folder / f"{options.suite}{end}" for end in (".json", ".png"))
    numbers.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    suite.plot(results).savefig(picture, dpi=150)
    console.print(f"numbers: {numbers}\npicture: {picture}", soft_wrap=True)
    if hasattr(suite, "page"):
        (folder / f"{options.suite}.md").write_text(suite.page(results))
    if hasattr(suite, "verdict") and (complaint := suite.verdict(results)):
        sys.exit(complaint)


if __name__ == "__main__":
    os.environ.setdefault("ASYSPLAT_SHARED", str(Path(__file__).parents[1] / "shared"))
    exit_at_unknown_overrides("benchmark")
    main()
