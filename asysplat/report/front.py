"""The points that no other beats in cost and in quality: found, and drawn before the rest."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.transforms import Bbox

from asysplat.report.style import FAINT, INK

Point = tuple[str, float, float]  # name, cost, quality


class Place(NamedTuple):
    """Where a name stands beside its point: offsets in typographic points, and alignment."""

    x: float
    y: float
    ha: str
    va: str


ABOVE, BELOW = Place(0, 6, "center", "bottom"), Place(0, -6, "center", "top")
LEFT, RIGHT = Place(-7, 0, "right", "center"), Place(7, 0, "left", "center")
ABOVE_LEFT, ABOVE_RIGHT = Place(0, 6, "right", "bottom"), Place(0, 6, "left", "bottom")
FONT = 9


def pareto_front(points: Sequence[Point], better: str) -> list[Point]:
    """Find the points (name, cost, quality) that no other equals or beats in both.

    The cheapest is first.
    """
    sign = 1 if better == "higher" else -1
    front: list[Point] = []
    for point in sorted(points, key=lambda point: (point[1], -sign * point[2])):
        if not front or sign * point[2] > sign * front[-1][2]:
            front.append(point)
    return front


def draw_front(
    axes: Axes, points: Sequence[Point], better: str, color: str, hollow: Collection[str] = ()
) -> None:
    """Draw the front as a line, the other points faded; each has its name.

    A name of a faded point for which there is no room is left out.

    Args:
        points: at least one.
        better: "higher" or "lower", of the quality.
        color: of the front.
        hollow: names of points to leave unfilled.
    """
    front = pareto_front(points, better)
    rest = [point for point in points if point not in front]
    axes.plot([p[1] for p in front], [p[2] for p in front], "-", color=color)
    for point in points:
        own, alpha = (color, 1.0) if point in front else (FAINT, 0.7)
        face = "none" if point[0] in hollow else own
        axes.plot(*point[1:], "o", color=own, mfc=face, ms=6 if point in rest else 7, alpha=alpha)
    axes.margins(x=0.2, y=0.18)
    axes.figure.draw_without_rendering()  # so that places in pixels are known
    taken: list[Bbox] = []
    for point in front:
        first = ABOVE_RIGHT if point == front[-1] else ABOVE_LEFT
        _label(axes, point, INK, (first, LEFT, RIGHT, BELOW, first), taken)
    for point in rest:
        _label(axes, point, FAINT, (BELOW, ABOVE, RIGHT, LEFT), taken)


def _label(
    axes: Axes, point: Point, color: str, places: Sequence[Place], taken: list[Bbox]
) -> None:
    """Write a name at the first place that is free, or at the last if it is the first again."""
    for number, place in enumerate(places):
        text = axes.annotate(
            point[0],
            point[1:],
            (place.x, place.y),
            textcoords="offset points",
            ha=place.ha,
            va=place.va,
            color=color,
            fontsize=FONT,
        )
        box = text.get_window_extent()
        if not any(map(box.overlaps, taken)) or place in places[:number]:
            taken.append(box)
            return
        text.remove()
