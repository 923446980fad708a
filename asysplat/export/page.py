"""A thread for each open page, which draws what is newest."""

import time
from collections.abc import Callable
from threading import Event, Thread

FLUID = 0.05  # seconds that a picture should take while something changes
REST = 0.2  # seconds without a change after which a picture is drawn in full
LEAST_PIXELS, MOST_PIXELS = 320 * 200, 1920 * 1080  # of a picture


class Page(Thread):
    """Draws for one open page: always the newest, leaving out what it came late for.

    While something changes it asks for as many pixels as it has time for, then once for all.

    Args:
        draw: draws with at most so many pixels; returns whether that were all.
    """

    def __init__(self, draw: Callable[[int], bool]):
        super().__init__(name="asysplat-page", daemon=True)
        self._draw, self.is_open = draw, True
        self._changed = Event()
        self._changed.set()

    def change(self) -> None:
        """Have the page drawn again."""
        self._changed.set()

    def leave(self) -> None:
        """Let the thread end, after the picture that it is drawing."""
        self.is_open = False
        self._changed.set()

    def run(self) -> None:
        in_full, coarse, pause = True, MOST_PIXELS // 16, REST
        while True:
            changed = self._changed.wait(None if in_full else pause)
            self._changed.clear()
            if not self.is_open:
                return
            start = time.perf_counter()
            in_full = self._draw(coarse if changed else MOST_PIXELS)
            seconds = time.perf_counter() - start
            if changed:
                factor = min(max(FLUID / seconds, 0.5), 2)
                coarse = round(min(max(factor * coarse, LEAST_PIXELS), MOST_PIXELS))
            else:
                # A page that is often interrupted leaves the machine at least half of its time.
                in_full, pause = True, max(REST, seconds)
