"""Small workloads over their yardsticks: ratios that a change of the code must not raise."""

import time
from functools import partial

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from asysplat.benchmark.bench.pairs import Pair, Run, make_pairs
from asysplat.benchmark.compare import RATIO, Watched
from asysplat.benchmark.plot import bars
from asysplat.benchmark.table import make_table, measured_on, spread, text
from asysplat.benchmark.timing import Measurement, Result, summary, time_in_rounds

BEST_OF = 3  # runs in a round: what disturbs a run makes it slower only
WATCHED = Watched(names=("workload", "over"), alike=(), kinds={"ratio": RATIO})


def measure(options: DictConfig, console: Console) -> Result:
    """Time every workload and its yardstick one after the other, in `options.repeats` rounds.

    On one thread, by the processor's time: whoever else uses the machine takes none of it.

    Returns:
        "rows": of each workload its "seconds", those of its "yardstick", and the "ratio" of both
        in the same round.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        pairs = list(make_pairs())
        rounds = [Measurement(partial(_seconds, pair)) for pair in pairs]
        with console.status(f"{options.repeats} rounds"):
            time_in_rounds(rounds, options.repeats)
    finally:
        torch.set_num_threads(threads)
    return {"rows": [_row(pair, timed) for pair, timed in zip(pairs, rounds, strict=True)]}


def _seconds(pair: Pair) -> dict[str, float]:
    return {"seconds": _best(pair.workload), "yardstick": _best(pair.yardstick)}


def _best(run: Run) -> float:
    return min(_processor_seconds(run) for _ in range(BEST_OF))


def _processor_seconds(run: Run) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def _row(pair: Pair, timed: Measurement) -> Result:
    own, yardstick = timed.seconds["seconds"], timed.seconds["yardstick"]
    return {
        "workload": pair.name,
        "over": pair.over,
        "seconds": summary(own),
        "yardstick": summary(yardstick),
        "ratio": summary([a / b for a, b in zip(own, yardstick, strict=True)]),
    }


def tables(results: Result) -> list[Table]:
    """Show the ratio of each workload to its yardstick."""
    columns = {
        "workload": text("{workload}"),
        "yardstick": text("its {over}"),
        "ms": spread("seconds", "{:.2f}"),
        "yardstick\nms": spread("yardstick", "{:.2f}"),
        "ratio": spread("ratio", "{:.3f}", unit=1.0),
    }
    notes = (
        f"{measured_on(results)}\n"
        f"one thread, the processor's time, the best of {BEST_OF} runs in each round"
    )
    return [make_table("Ratios to a yardstick", columns, results["rows"], notes, names=2)]


def plot(results: Result) -> Figure:
    """Plot the ratios, and 1."""
    rows = results["rows"]
    ratios = [row["ratio"] for row in rows]
    return bars(
        [f"{row['workload']} / its {row['over']}" for row in rows],
        {"ratio": [ratio["median"] for ratio in ratios]},
        ("as long", [1.0] * len(rows)),
        "seconds over those of the yardstick",
        spread=[ratio["iqr"] for ratio in ratios],
    )
