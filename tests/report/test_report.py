"""report.py as a user runs it."""

import subprocess
import sys


def run(repository, *overrides):
    return subprocess.run(
        [sys.executable, "report.py", *overrides], cwd=repository, capture_output=True, text=True
    )


def test_writes_markdown_and_a_page(repository, tmp_path):
    result = run(repository, "table=layers", f"logs={tmp_path}")
    assert result.returncode == 0, result.stderr
    assert "7m+1t" in result.stdout and "not run" in result.stdout
    page = tmp_path / "report" / "report.html"
    assert result.stdout.strip().endswith(f"page: {page}")
    assert "18.78" in page.read_text()
    assert "18.78" in (tmp_path / "report" / "report.md").read_text()


def test_overrides_of_the_sweeps_are_in_the_configuration(repository, tmp_path):
    given = ["table=layers", "data=dl3dv", "scale=paper", "data.root=/a/DL3DV", f"logs={tmp_path}"]
    result = run(repository, *given, 'overrides=["steps=7"]')
    assert result.returncode == 0, result.stderr
    text = (tmp_path / "report" / "report.md").read_text()
    assert "dl3dv data, 32 input views of 256x256, 7 steps of batch 8" in text
    command = "python train.py sweeps=layers data=dl3dv scale=paper data.root=/a/DL3DV steps=7"
    assert f"`{command}`" in text
    assert "protocol longlrm" in text


def test_an_unknown_table_lists_the_nearest(repository, tmp_path):
    result = run(repository, "table=layer", f"logs={tmp_path}")
    assert result.returncode != 0
    assert "table=layer is unknown: did you mean layers" in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())
