"""The regression watch: a slower workload is named."""

import torch
from omegaconf import OmegaConf
from rich.console import Console

from benchmarks import bench
from benchmarks.bench import Pair
from benchmarks.compare import compare
from benchmarks.options import describe_machine


def measure(monkeypatch, *times):
    """Measure workloads that compute the same as their baseline, so many times."""
    numbers = torch.rand(200_000)

    def work(count):
        for _ in range(count):
            numbers.sin().sum().item()

    pairs = [
        Pair(f"{i}", "once", lambda n=n: work(n), lambda: work(8)) for i, n in enumerate(times)
    ]
    monkeypatch.setattr(bench, "make_pairs", lambda: pairs)
    found = bench.measure(OmegaConf.create({"repeats": 5}), Console(quiet=True))
    return {"machine": describe_machine(), **found}


def test_a_workload_that_became_slower_is_named(monkeypatch):
    threads = torch.get_num_threads()
    old = measure(monkeypatch, 8, 4)
    assert torch.get_num_threads() == threads
    ratios = [row["ratio"]["median"] for row in old["rows"]]
    assert 1.3 < ratios[0] / ratios[1] < 3
    assert compare(old, old, bench.TRACKED).worse == []
    (worse,) = compare(old, measure(monkeypatch, 8, 32), bench.TRACKED).worse
    assert worse.startswith("slower: 1/once, ratio: ")
