"""The front is drawn as a line, and names do not overlap."""

from itertools import combinations

from matplotlib.figure import Figure

from paper.front import draw_front
from paper.style import FAINT

POINTS = [("slow", 3.0, 30.0), ("quick", 1.0, 20.0), ("base", 2.0, 25.0), ("worse", 2.5, 22.0)]
CROWD = [(f"crowded_{number}", 2.6 + 1e-3 * number, 21.0) for number in range(9)]


def draw(points, hollow=()):
    figure = Figure(figsize=(5, 4))
    axes = figure.subplots()
    draw_front(axes, points, "higher", "blue", hollow)
    figure.draw_without_rendering()
    return axes


def test_the_front_is_a_line_and_the_rest_is_faded():
    line, *dots = draw(POINTS, hollow=["base", "worse"]).lines
    assert list(line.get_xdata()) == [1.0, 2.0, 3.0]
    colors = {dot.get_xdata()[0]: dot.get_color() for dot in dots}
    assert colors == {3.0: "blue", 1.0: "blue", 2.0: "blue", 2.5: FAINT}
    faces = {dot.get_xdata()[0]: dot.get_markerfacecolor() for dot in dots}
    assert faces == {3.0: "blue", 1.0: "blue", 2.0: "none", 2.5: "none"}


def test_names_do_not_overlap_and_the_front_has_all_of_its_names():
    texts = draw(POINTS + CROWD).texts
    names = {text.get_text() for text in texts}
    assert {"slow", "quick", "base", "worse", "crowded_0"} <= names
    assert len(names) < len(POINTS + CROWD)
    boxes = [text.get_window_extent() for text in texts]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
