"""Progress of a refinement in the terminal and the browser, and how it is stopped."""

import math
import os
import signal
import time
from types import FrameType

from rich import progress

from asysplat.export.viewer import Viewer
from asysplat.refinement.refine import Refinement, RefinementProgress, Refining
from asysplat.scene import Gaussians
from asysplat.terminal import make_console

BAR_SECONDS = 0.1  # between two updates of the bar
VIEWER_SECONDS = 1.0  # between two updates of the viewer
PRINT_SECONDS = 10.0  # between two lines where there is no terminal
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class RefinementDisplay:
    """Show a progress bar and, if given, a viewer; Ctrl-C ends the refinement after its step.

    The second Ctrl-C interrupts, while a scheduler or a closed terminal may send any number of
    signals.
    """

    def __init__(self, viewer: Viewer | None = None):
        self.last: RefinementProgress | None = None
        self.stopped = False
        self._terminal = make_console().is_terminal
        self._printed = self._shown = time.monotonic()
        self._updated = -math.inf
        self._viewer = viewer
        if viewer is not None:
            print(f"viewer: {viewer.url}")

    def __enter__(self) -> "RefinementDisplay":
        self._handlers = {number: signal.signal(number, self._stop) for number in SIGNALS}
        self._bar = progress.Progress(
            "refining",
            progress.BarColumn(),
            "{task.fields[text]}",
            progress.TimeRemainingColumn(),
            disable=not self._terminal,
        )
        self._task = self._bar.add_task("", total=1.0, text="")
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        self._restore_handlers()
        if self._viewer is not None:
            self._viewer.close()

    def __call__(self, progress: RefinementProgress, refinement: Refining) -> bool:
        """Show the progress, and Gaussians that all views share; return whether to stop."""
        self.last = progress
        clock = time.monotonic()
        if clock - self._updated < BAR_SECONDS and progress.fraction < 1:
            return self.stopped  # the PSNR would wait for a GPU in every step
        self._updated = clock
        quality = f"PSNR {progress.psnr:.2f} dB"
        text = f"step {progress.step}, {quality}, {progress.gaussians:,} Gaussians"
        self._bar.update(self._task, completed=progress.fraction, text=text)
        if not self._terminal and clock - self._printed > PRINT_SECONDS:
            self._printed = clock
            print(f"{progress.seconds:.0f} s: {text}", flush=True)
        shown = self._viewer is not None and isinstance(refinement, Refinement)
        if shown and clock - self._shown > VIEWER_SECONDS:
            self._shown = clock
            self._viewer.show(refinement.gaussians, text)
        return self.stopped

    def show(self, gaussians: Gaussians) -> None:
        """Show the result in the viewer, if there is one, until Ctrl-C."""
        self._bar.stop()
        self._restore_handlers()
        if self._viewer is not None:
            self._viewer.show(gaussians, "done")
            print(f"viewer: {self._viewer.url}, until Ctrl-C")
            self._viewer.wait()

    def _stop(self, number: int, frame: FrameType | None) -> None:
        first, self.stopped = not self.stopped, True
        again = ""
        if number == signal.SIGINT:
            # Before the message, which the next signal may follow at once.
            signal.signal(number, self._handlers[number])
            again = "; repeat to stop at once and save nothing"
        if first or again:
            # To stderr, without print, which is not reentrant and may be running.
            os.write(2, f"stopping after this step{again}\n".encode())

    def _restore_handlers(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
