"""report.py as a user runs it."""

import pytest


@pytest.mark.medium
def test_writes_markdown_and_a_page(run_script, tmp_path):
    result = run_script("report.py", "table=layers", f"logs={tmp_path}")
    assert result.returncode == 0, result.stderr
    assert "7m+1t" in result.stdout and "not run" in result.stdout
    page = tmp_path / "report" / "report.html"
    assert result.stdout.strip().endswith(f"page: {page}")
    assert "18.78" in page.read_text()
    assert "18.78" in (tmp_path / "report" / "report.md").read_text()


@pytest.mark.medium
def test_overrides_of_the_sweeps_reach_the_configuration(run_script, tmp_path):
    given = ["table=layers", "data=dl3dv", "scale=paper", "data.root=/a/DL3DV", f"logs={tmp_path}"]
    result = run_script("report.py", *given, 'overrides=["steps=7"]')
    assert result.returncode == 0, result.stderr
    text = (tmp_path / "report" / "report.md").read_text()
    assert "dl3dv data, 32 input views of 256x256, 7 steps of batch 24" in text
    command = "python train.py sweeps=layers data=dl3dv scale=paper data.root=/a/DL3DV steps=7"
    assert f"`{command}`" in text
    assert "protocol longlrm" in text
