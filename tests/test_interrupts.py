"""Ctrl-C while modules load, a closed terminal, and SIGTERM."""

import signal
import subprocess
import sys
import textwrap

import pytest


@pytest.mark.parametrize("ignored", [False, True])
def test_an_interrupt_while_modules_load_ends_the_process(repository, ignored):
    script = f"""
        import signal
        from asysplat.interrupts import end_at_interrupt

        signal.signal(signal.SIGINT, signal.SIG_IGN if {ignored} else signal.default_int_handler)
        end_at_interrupt()
        signal.raise_signal(signal.SIGINT)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, cwd=repository, capture_output=True, timeout=50)
    assert done.returncode == (0 if ignored else -signal.SIGINT) and not done.stderr


@pytest.mark.parametrize("nohup", [False, True])
def test_a_closed_terminal_ends_the_process_like_sigterm(repository, nohup):
    script = f"""
        import os, signal, time
        from asysplat.interrupts import handle_signals

        signal.signal(signal.SIGHUP, signal.SIG_IGN if {nohup} else signal.SIG_DFL)
        handle_signals()
        signal.raise_signal(signal.SIGHUP)
        time.sleep(0.2)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, cwd=repository, capture_output=True, timeout=50)
    assert done.returncode == (0 if nohup else -signal.SIGTERM) and not done.stderr


@pytest.mark.medium
def test_sigterm_ends_a_command_quietly(repository):
    script = """
        import runpy, signal, sys
        from asysplat.data import readers

        readers.find_scenes = lambda *_, **__: signal.raise_signal(signal.SIGTERM)
        sys.argv = ["check", "."]
        runpy.run_module("asysplat.data.check", run_name="__main__")
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, cwd=repository, capture_output=True, timeout=100)
    assert done.returncode == -signal.SIGTERM and not done.stderr
