"""What ends a run and is no mistake of the code is a sentence; all else is not."""

import errno
import os
import re

import pytest
import torch

from asysplat.cli import check_command, error_message

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "logs/events")
FULL_AS_CAUSE = RuntimeError("write")
FULL_AS_CAUSE.__cause__ = FULL
LOST = RuntimeError("DataLoader worker (pid 12) is killed by signal: Killed. ")
LOST_PEER = RuntimeError("[/gloo/transport/tcp/pair.cc:545] Read error: Connection reset by peer.")
SENTENCES = {
    "a full disk behind": (FULL_AS_CAUSE, "no space on the disk"),
    "a quota": (OSError(errno.EDQUOT, "Disk quota exceeded"), "no space on the disk (Disk quota"),
    "a full GPU": (
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total"),
        "no memory left (CUDA out of memory. Tried to allocate 2.00 GiB): choose fewer",
    ),
    "a full memory": (MemoryError(), "no memory left (no reason given): choose fewer"),
    "a lost peer": (LOST_PEER, "the connection to another process of this training was lost"),
    "a lost loader": (LOST, "a process that loads data was lost (DataLoader worker (pid 12) is ki"),
}


@pytest.mark.parametrize("case", SENTENCES)
def test_a_known_error_is_a_sentence(case):
    error, sentence = SENTENCES[case]
    assert sentence in error_message(error)


def test_torch_s_full_memory_is_a_sentence():
    with pytest.raises(RuntimeError) as raised:
        torch.empty(2**60)
    found = r"left \(can't allocate memory: you tried to allocate \d+ bytes\): choose fewer"
    assert re.search(found, error_message(raised.value))


PORT_IN_USE = torch.distributed.DistNetworkError("The server socket failed to listen: EADDRINUSE")
OTHERS = [RuntimeError("shapes"), OSError(errno.EIO, "I/O"), KeyError(1), PORT_IN_USE]


@pytest.mark.parametrize("error", OTHERS)
def test_other_errors_have_no_message(error):
    assert error_message(error) is None


@pytest.mark.parametrize("script", ["benchmark", "evaluate", "reconstruct", "report", "train"])
def test_a_script_takes_a_command_without_options(script, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [f"{script}.py"])
    monkeypatch.setattr("asysplat.cli.end_at_interrupt", lambda: None)
    check_command(script)
    monkeypatch.setattr("sys.argv", [f"{script}.py", "--steps", "20"])
    with pytest.raises(SystemExit):
        check_command(script)
    assert "unrecognized arguments: --steps" in capsys.readouterr().err
