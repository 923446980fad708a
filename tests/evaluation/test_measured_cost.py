"""Seconds are the mean of all but the longest; memory is the largest peak since each start."""

import mmap
from types import SimpleNamespace

import pytest
import torch

from asysplat.evaluation import measured_cost
from asysplat.evaluation.measured_cost import (
    CostMeter,
    mean_but_longest,
    peak_memory_gb,
    reset_peak_memory,
)

CPU = torch.device("cpu")


def test_the_mean_leaves_the_longest_out_once():
    assert mean_but_longest([2.0]) == 2
    assert mean_but_longest([1.0, 60.0, 2.0, 6.0]) == 3
    assert mean_but_longest([4.0, 4.0, 1.0]) == 2.5


def test_work_is_timed_from_start_to_stop_and_has_no_peak_where_it_cannot_be_reset(monkeypatch):
    monkeypatch.setattr(measured_cost, "reset_peak_memory", lambda device: False)
    clock = iter([10.0, 11.0, 20.0, 25.0, 30.0, 32.0])
    monkeypatch.setattr(measured_cost, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    work = CostMeter(CPU)
    for _ in range(3):
        work.start()
        work.stop()
    assert work.seconds == [1, 5, 2] and not work.gb


@pytest.mark.skipif(not reset_peak_memory("cpu"), reason="the peak of the process cannot be reset")
def test_measured_memory_is_that_of_the_work_only():
    def allocate(numbers):
        """Allocate 4 bytes each from the system: reused memory would not raise the peak."""
        with mmap.mmap(-1, 4 * numbers) as memory:
            for page in range(0, len(memory), mmap.PAGESIZE):
                memory[page] = 1

    small, large = CostMeter(CPU), CostMeter(CPU)
    for work, numbers in ((small, 1000), (large, 50_000_000), (large, 1000), (small, 1000)):
        work.start()
        allocate(numbers)
        work.stop()
    assert max(large.gb) - max(small.gb) == pytest.approx(0.2, abs=0.02)


@pytest.mark.gpu
def test_peak_memory_of_a_gpu():
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    x = torch.empty(50_000_000, device="cuda")
    del x
    assert peak_memory_gb("cuda") == pytest.approx((before + 2e8) / 1e9, abs=1e-3)
