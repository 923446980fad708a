"""The points that no other beats in cost and in quality: found, and drawn before the rest."""

from collections.abc import Collection, Sequence

from matplotlib.axes import Axes

from asysplat.report.style import FAINT, INK

Point = tuple[str, float, float]  # name, cost, quality


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
    axes: Axes, points: Sequence[Point], better: str, colour: str, hollow: Collection[str] = ()
) -> None:
    """Draw the front as a line, the other points faded; each has its name.

    Args:
        points: at least one.
        better: "higher" or "lower", of the quality.
        colour: of the front.
        hollow: names of points to leave unfilled.
    """
    front = pareto_front(points, better)
    rest = [point for point in points if point not in front]
    axes.plot([p[1] for p in front], [p[2] for p in front], "-", color=colour)
    for point in points:
        own, alpha = (colour, 1.0) if point in front else (FAINT, 0.7)
        face = "none" if point[0] in hollow else own
        axes.plot(*point[1:], "o", color=own, mfc=face, ms=6 if point in rest else 7, alpha=alpha)
    for point in rest:
        _label(axes, point, FAINT, "center", "top")
    for point in front:
        _label(axes, point, INK, "left" if point == front[-1] else "right", "bottom")
    axes.margins(x=0.2, y=0.18)


def _label(axes: Axes, point: Point, colour: str, ha: str, va: str) -> None:
    """Write a name above the front and away from its end, so that neighbours stay apart."""
    name, cost, quality = point
    offset = (0, 6 if va == "bottom" else -6)
    axes.annotate(
        name,
        (cost, quality),
        offset,
        textcoords="offset points",
        ha=ha,
        va=va,
        color=colour,
        fontsize=9,
    )
