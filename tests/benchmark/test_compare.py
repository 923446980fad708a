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


CHANGES = {  # of a row: the sentence on what is worse, and on what is better
    "slower": ({"seconds": summary(3.0, 0.1)}, "slower: a, seconds: 3 ± 0.1 s, was 2 ± 0.1 s", ""),
    "faster": ({"seconds": summary(1.0, 0.1)}, "", "faster: a, seconds: 1 ± 0.1 s, was 2 ± 0.1 s"),
    "within noise": ({"seconds": summary(3.0, 1.0)}, "", ""),
    "too little": ({"seconds": summary(2.3, 0.01)}, "", ""),
    "less exact": ({"wrong": {"x": 5e-6, "y": 1e-7}}, "less exact: a, wrong: 5e-06, was 1e-06", ""),
    "as exact": ({"wrong": {"x": 1.9e-6, "y": 0.0}}, "", ""),
    "worse images": ({"psnr": 29.8}, "less exact: a, psnr: 29.8 dB, was 30 dB", ""),
    "within the noise of the row": ({"psnr": 29.8, "noise": {"psnr": 0.3}}, "", ""),
    "a lower rate": ({"rate": summary(5.0)}, "slower: a, rate: 5 / s, was 8 / s", ""),
    "an error where there was none": ({"none": 1e-3}, "less exact: a, none: 0.001, was 0", ""),
    "better images": ({"psnr": 30.2}, "", "more exact: a, psnr: 30.2 dB, was 30 dB"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_changes_beyond_noise_are_named(case):
    numbers, worse, better = CHANGES[case]
    before = row(rate=summary(8.0), none=0.0)
    comparison = compare(results(before), results(before | numbers), TRACKED)
    assert comparison.worse == list(filter(None, [worse]))
    assert comparison.better == list(filter(None, [better]))


def test_missing_numbers_are_named_and_are_no_change():
    old = results(row(), row("b", seconds=None))
    new = results(row(psnr=None), row("c", seconds=summary(90.0)))
    comparison = compare(old, new, TRACKED)
    assert comparison.worse == comparison.better == []
    missing = ["a, psnr: was 30 dB", "b, wrong: was 1e-06", "b, psnr: was 30 dB"]
    assert comparison.missing == missing and comparison.compared == 2
    first, *_, verdict = comparison.lines()
    assert verdict.startswith("green: none of 2 numbers") and "any more" in first


def test_other_sizes_are_other_rows():
    with pytest.raises(InputError, match=r"^compare= has none of the rows"):
        compare(results(row()), results(row(size=[3, 5])), TRACKED)


def test_seconds_of_another_machine_are_not_compared():
    old = results(row(ratio=summary(1.0)), cpu="other", torch="2.10")
    new = results(row(seconds=summary(9.0), ratio=summary(2.0), psnr=20.0))
    comparison = compare(old, new, TRACKED)
    note = "another machine: cpu other then and one now; seconds are not compared."
    assert comparison.notes == [note]
    assert [sentence.partition(":")[0] for sentence in comparison.worse] == ["slower", "less exact"]
    assert "ratio" in comparison.worse[0]


def test_files_that_cannot_be_compared_are_refused(tmp_path):
    old, new = tmp_path / "old.json", tmp_path / "made.json"
    refused = {
        None: r"^compare=.*old\.json cannot be read",
        "{": "cannot be read",
        "[1]": "has no results",
        '{"machine": {}, "suite": "ops"}': "is of suite=ops: name a file of",
    }
    for content, says in refused.items():
        if content is not None:
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


@pytest.mark.medium
def test_the_exit_status_is_1_where_a_number_became_worse(run, tmp_path):
    old = tmp_path / "old" / "made.json"
    assert run(row(), output=old.parent).returncode == 0
    same = run(row(), compare=old)
    assert same.returncode == 0 and "green: none of 3 numbers became slower" in same.stdout
    worse = run(row(seconds=summary(9.0)), compare=old)
    assert worse.returncode == 1 and "slower: a, seconds: 9 s, was 2 ± 0.1 s" in worse.stdout
    assert "1 of 3 numbers became slower or less exact beyond noise." in worse.stdout


def test_the_old_file_is_not_written_over(run, tmp_path):
    old = tmp_path / "made.json"
    old.write_text(json.dumps(results(row())))
    before = old.read_bytes()
    refused = run(row(), compare=old)
    assert refused.returncode == 1 and "would be written over: set output=" in refused.stderr
    assert old.read_bytes() == before


def test_numbers_tables_and_figure_are_written(run, tmp_path):
    assert run(row(seconds=summary(2.0, 0.9)), row("b|")).returncode == 0
    found = json.loads((tmp_path / "made.json").read_text(), parse_constant=pytest.fail)
    assert found["suite"] == "made" and found["revision"] and found["machine"]["cores"]
    assert (tmp_path / "made.md").read_text().splitlines()[:6] == [
        "## Rows",
        "",
        "| scene | ms |",
        "| :-- | --: |",
        "| a | 2000.0 ± 900.0 busy |",
        r"| b\| | 2000.0 ± 100.0 |",
    ]
    assert (tmp_path / "made.png").stat().st_size > 0
