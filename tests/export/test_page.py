"""A page's thread: coarse, in full, and never what is late."""

from queue import SimpleQueue
from threading import Event

import numpy as np

from asysplat.export.page import MOST_PIXELS, Page


class Drawings:
    """A draw for `Page` that waits for its turn, and remembers how many pixels it was asked for."""

    def __init__(self):
        self.asked, self.turn = SimpleQueue(), Event()

    def __call__(self, pixels):
        self.turn.wait(60)
        self.asked.put(pixels)
        return pixels == MOST_PIXELS


def test_coarse_first_and_in_full_at_rest():
    drawings = Drawings()
    drawings.turn.set()
    page = Page(drawings)
    page.start()
    assert drawings.asked.get(timeout=60) < MOST_PIXELS
    assert drawings.asked.get(timeout=60) == MOST_PIXELS
    page.leave()
    page.join()
    assert drawings.asked.empty()


def test_changes_that_come_late_are_drawn_once():
    drawings = Drawings()
    page = Page(drawings)
    page.start()
    for _ in range(20):
        page.change()
    drawings.turn.set()
    asked = [drawings.asked.get(timeout=60)]
    while asked[-1] < MOST_PIXELS:
        asked.append(drawings.asked.get(timeout=60))
    page.leave()
    page.join()
    assert 2 <= len(asked) <= 3  # the first, the changes meanwhile as one, all pixels
    np.testing.assert_array_less(asked[:-1], MOST_PIXELS)
