"""Two result files of a suite: the sentences on their differences, and the exit status."""

import json
from types import SimpleNamespace

import pytest
from matplotlib.figure import Figure

from asysplat.errors import InputError
from benchmarks import compare as kinds
from benchmarks import options
from benchmarks.compare import TrackedMetrics, compare, read_old
from benchmarks.table import make_table, median_iqr_column, text_column

KINDS = {"seconds": kinds.TIME, "rate": kinds.RATE, "ratio": kinds.RATIO}
KINDS |= dict.fromkeys(("wrong", "none"), kinds.ERROR) | {"psnr": kinds.DECIBELS}
TRACKED = TrackedMetrics(("scene", "part"), ("size",), KINDS)
MACHINE = {"cpu": "one", "cores": 2, "threads": 2, "torch": "2.11"}


def summary(median, iqr=0.0):
    return {"median": median, "iqr": iqr}


def row(scene="a", **numbers):
    values = {"seconds": summary(2.0, 0.1), "wrong": {"x": 1e-7, "y": 1e-6}, "psnr": 30.0}
    return {"scene": scene, "part": None, "size": [3, 4]} | values | numbers


def results(*rows, **machine):
    return {"suite": "made", "revision": "r", "machine": MACHINE | machine, "rows": list(rows)}


@pytest.mark.parametrize(
    "numbers, worse, better",
    [
        ({"seconds": summary(3.0, 0.1)}, "slower: a, seconds: 3 ± 0.1 s, was 2 ± 0.1 s", ""),
        ({"seconds": summary(1.0, 0.1)}, "", "faster: a, seconds: 1 ± 0.1 s, was 2 ± 0.1 s"),
        ({"seconds": summary(3.0, 1.0)}, "", ""),  # within noise
        ({"seconds": summary(2.3, 0.01)}, "", ""),  # too little
        ({"wrong": {"x": 5e-6, "y": 1e-7}}, "less exact: a, wrong: 5e-06, was 1e-06", ""),
        ({"wrong": {"x": 1.9e-6, "y": 0.0}}, "", ""),
        ({"psnr": 29.8}, "less exact: a, psnr: 29.8 dB, was 30 dB", ""),
        ({"psnr": 29.8, "noise": {"psnr": 0.3}}, "", ""),
        ({"psnr": 30.2}, "", "more exact: a, psnr: 30.2 dB, was 30 dB"),
        ({"rate": summary(5.0)}, "slower: a, rate: 5 / s, was 8 / s", ""),
        ({"none": 1e-3}, "less exact: a, none: 0.001, was 0", ""),
    ],
)
def test_changes_beyond_noise_are_named(numbers, worse, better):
    before = row(rate=summary(8.0), none=0.0)
    comparison = compare(results(before), results(before | numbers), TRACKED)
    assert comparison.worse == list(filter(None, [worse]))
    assert comparison.better == list(filter(None, [better]))


def test_missing_numbers_are_no_change_and_seconds_of_another_machine_are_not_compared():
    old = results(row(), row("b", seconds=None))
    new = results(row(psnr=None), row("c", seconds=summary(90.0)))
    comparison = compare(old, new, TRACKED)
    assert comparison.worse == comparison.better == [] and comparison.compared == 2
    missing = ["a, psnr: was 30 dB", "b, wrong: was 1e-06", "b, psnr: was 30 dB"]
    assert comparison.missing == missing

    old = results(row(ratio=summary(1.0)), cpu="other")
    new = results(row(seconds=summary(9.0), ratio=summary(2.0), psnr=20.0))
    slower, less_exact = compare(old, new, TRACKED).worse
    assert slower.startswith("slower: a, ratio") and less_exact.startswith("less exact: a, psnr")


def test_files_that_cannot_be_compared_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"^compare= has none of the rows"):
        compare(results(row()), results(row(size=[3, 5])), TRACKED)
    old, new = tmp_path / "old.json", tmp_path / "made.json"
    refused = {"{": "cannot be read", '{"machine": {}, "suite": "ops"}': "is of suite=ops: name"}
    for content, says in refused.items():
        old.write_text(content)
        with pytest.raises(InputError, match=says):
            read_old(str(old), new)
    assert read_old(None, new) is None


@pytest.fixture
def run(monkeypatch, run_script, tmp_path):
    """benchmark.py with a suite that measures these rows."""

    def script(*rows, **words):
        columns = {"scene": text_column("{scene}"), "ms": median_iqr_column("seconds")}
        suite = SimpleNamespace(
            measure=lambda *_: {"rows": list(rows)},
            tables=lambda found: [make_table("Rows", columns, found["rows"])],
            plot=lambda _: Figure(),
            TRACKED=TRACKED,
        )
        monkeypatch.setattr(options, "find_suite", lambda _: suite)
        overrides = {"suite": "made", "output": tmp_path} | words
        return run_script("benchmark.py", *(f"{key}={value}" for key, value in overrides.items()))

    return script


def test_results_are_written_and_the_exit_status_is_1_where_a_number_became_worse(run, tmp_path):
    old = tmp_path / "old" / "made.json"
    assert run(row(seconds=summary(2.0, 0.1)), output=old.parent).returncode == 0
    found = json.loads(old.read_text(), parse_constant=pytest.fail)
    assert found["suite"] == "made" and found["revision"] and found["machine"]["cores"]
    assert "| a | 2000.0 ± 100.0 |" in old.with_suffix(".md").read_text()
    assert old.with_suffix(".png").stat().st_size > 0
    same = run(row(), compare=old)
    assert same.returncode == 0 and "green: none of 3 numbers became slower" in same.stdout
    worse = run(row(seconds=summary(9.0)), compare=old)
    assert worse.returncode == 1 and "slower: a, seconds: 9 s, was 2 ± 0.1 s" in worse.stdout

    before = old.read_bytes()
    refused = run(row(), compare=old, output=old.parent)
    assert refused.returncode == 1 and "would be written over: set output=" in refused.stderr
    assert old.read_bytes() == before
