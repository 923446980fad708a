"""What a person sees of a refinement, and how it is stopped."""

import os
import signal
import time
from types import FrameType, TracebackType

from rich import progress
from rich.console import Console

from asysplat.export.viewer import Viewer
from asysplat.refinement.refine import Refinement, RefinementProgress
from asysplat.scene import Gaussians, Views

SHOWN_EVERY = 1.0  # seconds between two states that the viewer is given
TOLD_EVERY = 10.0  # seconds between two lines where there is no terminal
STDERR = 2
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class RefinementDisplay:
    """A progress bar, and a viewer if wanted; Ctrl-C ends the refinement after its step.

    Use it as a context: the signals are its own until its end, and from the first one on those of
    before.

    Args:
        views: the photographs.
        view: whether to open a viewer in the browser.
    """

    def __init__(self, views: Views, view: bool):
        self.last: RefinementProgress | None = None
        self.stopped = False
        self._console = Console()
        self._told = self._shown = time.monotonic()
        self._viewer = None
        if view:
            self._viewer = Viewer(views)
            print(f"viewer: {self._viewer.url}")

    def __enter__(self) -> "RefinementDisplay":
        self._before = {number: signal.signal(number, self._stop) for number in SIGNALS}
        self._bar = progress.Progress(
            progress.TextColumn("refining"),
            progress.BarColumn(),
            progress.TextColumn("{task.fields[text]}"),
            progress.TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=1.0, text="")
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
        self._restore()
        if self._viewer is not None:
            self._viewer.close()

    def __call__(self, now: RefinementProgress, refinement: Refinement) -> bool:
        """Show how far it is; return whether to stop."""
        self.last = now
        text = f"step {now.step}, PSNR {now.psnr:.2f} dB, {now.gaussians:,} Gaussians"
        self._bar.update(self._task, completed=now.share, text=text)
        clock = time.monotonic()
        if not self._console.is_terminal and clock - self._told > TOLD_EVERY:
            self._told = clock
            print(f"{now.seconds:.0f} s: {text}", flush=True)
        if self._viewer is not None and clock - self._shown > SHOWN_EVERY:
            self._shown = clock
            self._viewer.show(refinement.gaussians, text)
        return self.stopped

    def show(self, gaussians: Gaussians) -> None:
        """Show what came out in the viewer, if there is one, until Ctrl-C."""
        self._bar.stop()
        self._restore()
        if self._viewer is not None:
            self._viewer.show(gaussians, "done")
            print(f"viewer: {self._viewer.url}, until Ctrl-C")
            self._viewer.wait()

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
        self._restore()  # before it is said: the next one may follow at once
        # print may be under way, and cannot be entered twice.
        os.write(STDERR, b"stopping after this step; once more, and nothing is kept\n")

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
