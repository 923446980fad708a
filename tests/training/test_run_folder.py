"""Which folder a run has: its own again, if it was cut off, and of nobody else."""

import multiprocessing
import os
import signal
import sys
import time

import pytest
from torch.distributed import TCPStore

from asysplat.errors import InputError
from asysplat.training.run_folder import job_name, locked, run_folder

FORK = multiprocessing.get_context("fork")


@pytest.fixture
def cut_off(tmp_path):
    """A run that has a checkpoint and no results."""
    last = tmp_path / "logs" / "1" / "checkpoints" / "last.ckpt"
    last.parent.mkdir(parents=True)
    last.touch()
    return last


def test_a_run_that_was_cut_off_goes_on_in_its_folder(cut_off):
    run, logs = cut_off.parents[1], str(cut_off.parents[2])
    for asked in ("last", str(cut_off)):
        assert run_folder(asked, logs, "fresh") == str(run)
    cut_off.rename(cut_off.with_name("previous.ckpt"))  # killed while the last was replaced
    assert run_folder("last", logs, "fresh") == str(run)


@pytest.mark.medium
def test_nothing_is_written_through_the_links_of_a_run_that_is_resumed(
    cut_off, tmp_path, run_script
):
    """Hydra would, before the training begins."""
    run, mine = cut_off.parents[1], tmp_path / "thesis.tex"
    (run / ".hydra").mkdir()
    (run / ".hydra" / "config.yaml").symlink_to(mine)
    logs = [f"paths.logs={tmp_path}", f"name={run.parent.name}"]
    result = run_script("train.py", "ckpt_path=last", *logs)
    assert "config.yaml is a link, and" in result.stderr and "Traceback" not in result.stderr
    assert result.returncode == 1 and not mine.exists()


def test_all_else_starts_in_a_folder_of_its_own(cut_off, tmp_path):
    logs = str(cut_off.parents[2])
    best = cut_off.with_name("best.ckpt")
    best.touch()
    assert run_folder(None, logs, "fresh") == "fresh"
    assert run_folder("last", str(tmp_path / "other"), "fresh") == "fresh"
    assert run_folder(str(best), logs, "fresh") == "fresh"
    (cut_off.parents[1] / "metrics.json").touch()  # more steps of a run that has its results
    assert run_folder("last", logs, "fresh") == "fresh"


def test_a_job_is_named_by_the_options_that_vary(monkeypatch):
    command = ["-m", "model/head=longlrm,pixel", "data.root=/a,/b c", "test_sets=[x,y]", "steps=8"]
    monkeypatch.setattr(sys, "argv", ["train.py", *command])
    options = ["model/head=longlrm", "data.root=/b c", "test_sets=[x,y]", "steps=8", "seed=2"]
    assert job_name(options, {"seed": "range(3)"}) == "head=longlrm,data.root=bc,seed=2"
    monkeypatch.setattr(sys, "argv", ["a scheduler's"])
    assert job_name(options, None) == "head=longlrm,data.root=bc,test_sets=x,y,steps=8,seed=2"
    assert len(job_name([f"key_{number}=value" for number in range(99)], None)) <= 120


def hold(folder, pipe):
    """Claim the folder, as a run with a process that loads data, which outlives it."""
    with locked(folder):
        loader = FORK.Process(target=time.sleep, args=(600,))
        loader.start()
        pipe.send(loader.pid)
        time.sleep(600)


def test_no_two_train_in_one_folder_until_one_is_killed(tmp_path):
    folder = tmp_path / "run"
    ours, theirs = FORK.Pipe()
    run = FORK.Process(target=hold, args=(folder, theirs))
    run.start()
    loader = ours.recv()
    with (
        pytest.raises(InputError, match=r"run is a run that another process still trains"),
        locked(folder),
    ):
        pytest.fail("both train there")
    run.kill()
    run.join()
    os.kill(loader, 0)  # it lives
    with locked(folder):
        assert folder.is_dir()
    os.kill(loader, signal.SIGKILL)


def test_processes_of_torchrun_get_the_folder_of_the_first(monkeypatch, tmp_path):
    """Its agents hold a store; a restart chooses again."""
    store = TCPStore("localhost", 0, is_master=True)
    launched = {"TORCHELASTIC_USE_AGENT_STORE": "True", "TORCHELASTIC_RESTART_COUNT": "0"}
    launched |= {"MASTER_ADDR": "localhost", "MASTER_PORT": str(store.port)}

    def choose(rank, new, **others):
        for name, value in (launched | {"RANK": rank} | others).items():
            monkeypatch.setenv(name, value)
        return run_folder(None, str(tmp_path), new)

    assert [choose("0", "noon"), choose("1", "a second later")] == ["noon", "noon"]
    again = {"TORCHELASTIC_RESTART_COUNT": "1"}
    assert [choose("0", "one", **again), choose("1", "two", **again)] == ["one", "one"]


def test_processes_of_slurm_get_the_folder_of_their_job(monkeypatch, tmp_path):
    for name, value in {"SLURM_JOB_ID": "17", "SLURM_STEP_ID": "3", "SLURM_NTASKS": "8"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("SLURM_JOB_NAME", "train")
    expected = str(tmp_path / "slurm_17_3")
    assert {run_folder(None, "", str(tmp_path / new)) for new in ("noon", "later")} == {expected}
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert run_folder(None, "", str(tmp_path / "noon")) == f"{expected}_1"
    monkeypatch.setenv("SLURM_NTASKS", "1")
    assert run_folder(None, "", str(tmp_path / "noon")) == str(tmp_path / "noon")
