"""An interruption at a moment at which Python can raise nothing."""

import ctypes
import signal
import subprocess
import sys
import textwrap

import pytest

from asysplat.interrupts import keep_interrupts

SWALLOWED = {
    "a callback of C code": "ctypes.CFUNCTYPE(None)(interrupted)()",
    "a finalizer": "type('Ends', (), {'__del__': lambda self: interrupted()})()",
    "several, one after the other": "[ctypes.CFUNCTYPE(None)(interrupted)() for _ in range(3)]",
}


@pytest.mark.parametrize("case", SWALLOWED)
@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("once", [True, False])
def test_an_interrupt_that_python_would_ignore_arrives(repository, case, kept, once):
    script = f"""
        import ctypes, signal, sys, time
        from asysplat.interrupts import interrupt_once, keep_interrupts

        def interrupted():
            signal.raise_signal(signal.SIGINT)

        signal.signal(signal.SIGINT, signal.default_int_handler)
        if {once}:
            interrupt_once()
        if {kept}:
            keep_interrupts()
        try:
            {SWALLOWED[case]}
            time.sleep({60 if kept else 0.2})
            print("went on")
        except KeyboardInterrupt:
            print("stopped")
    """
    command, options = [sys.executable, "-c", textwrap.dedent(script)], {"timeout": 50}
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, **options)
    assert done.stdout == ("stopped\n" if kept else "went on\n")
    assert ("Traceback" in done.stderr) is not kept, done.stderr
    assert done.returncode == 0


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


def test_other_errors_are_printed_as_before(monkeypatch):
    told = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    keep_interrupts()
    ctypes.CFUNCTYPE(None)(lambda: 1 / 0)()
    assert [one.exc_type for one in told] == [ZeroDivisionError]


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


# Each with a function that it calls first.
COMMANDS = {
    "examples/reconstruct_scene.py": "asysplat.data:ProceduralScene",
    "asysplat/export/viewer.py": "asysplat.export.gaussians:read_gaussians",
    "asysplat/data/check/__main__.py": "asysplat.data.readers:find_scenes",
}


@pytest.mark.medium
@pytest.mark.parametrize("command", COMMANDS)
def test_sigterm_ends_a_command_quietly(repository, command):
    module, name = COMMANDS[command].split(":")
    words = [] if command.startswith("examples") else ["."]
    script = f"""
        import runpy, signal, sys
        import {module} as module

        module.{name} = lambda *_, **__: signal.raise_signal(signal.SIGTERM)
        sys.argv = ["{command}", *{words}]
        runpy.run_path("{command}", run_name="__main__")
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, cwd=repository, capture_output=True, timeout=100)
    assert done.returncode == -signal.SIGTERM and not done.stderr
