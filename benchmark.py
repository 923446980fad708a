"""Time against error, and quality against seconds, in one process.

python benchmark.py suite=render scenes=[A,C]
python benchmark.py suite=pareto compare=docs/results/pareto.json
"""

import os
import sys
from pathlib import Path

os.environ.setdefault(
    "OMP_WAIT_POLICY", "PASSIVE"
)  # read when torch is imported: waiting threads must not spin

from asysplat.cli import check_command, command

if __name__ == "__main__":
    check_command("benchmark")

from omegaconf import DictConfig

from asysplat.errors import InputError
from asysplat.files import check_writable
from asysplat.runs.machine import revision
from asysplat.terminal import make_console
from benchmarks.compare import compare, read_old
from benchmarks.options import describe_machine, find_suite
from benchmarks.table import write_results


@command("benchmark")
def benchmark(options: DictConfig) -> None:
    """Measure a suite, print and write the results; exit with 1 if any is worse than `compare`."""
    suite = find_suite(options.suite)
    if not isinstance(options.repeats, int) or options.repeats < 1:
        raise InputError(f"repeats={options.repeats} cannot be: give a whole number from 1.")
    path = Path(options.output) / options.suite
    check_writable(path.parent, "output")
    old = read_old(options.compare, path.with_suffix(".json"))
    console = make_console()
    code = {"suite": options.suite, "revision": revision()}
    results = code | {"machine": describe_machine()} | suite.measure(options, console)
    tables = suite.tables(results)
    for table in tables:
        console.print(table)
    figure = suite.plot(results) if hasattr(suite, "plot") else None
    for file in write_results(results, tables, figure, path):
        console.print(f"written: {file}", soft_wrap=True)
    worse = False
    if old is not None:
        comparison = compare(old, results, suite.TRACKED)
        for line in comparison.lines():
            console.print(line, soft_wrap=True, highlight=False)
        worse = bool(comparison.worse)
    if hasattr(suite, "verdict") and (message := suite.verdict(results)):
        sys.exit(message)
    if worse:
        sys.exit(1)


if __name__ == "__main__":
    benchmark()
