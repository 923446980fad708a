"""Find and draw the Pareto front: the points that no other beats in both cost and quality."""

from collections.abc import Collection, Sequence

from matplotlib.axes import Axes

from paper.style import FAINT, INK

Point = tuple[str, float | int, float | int]  # name, cost, quality
# Where a name is beside its point: offset in typographic points, alignments.
ABOVE, BELOW = ((0, 6), "center", "bottom"), ((0, -6), "center", "top")
LEFT, RIGHT = ((-7, 0), "right", "center"), ((7, 0), "left", "center")
ABOVE_LEFT, ABOVE_RIGHT = ((0, 6), "right", "bottom"), ((0, 6), "left", "bottom")
AROUND = (BELOW, ABOVE, RIGHT, LEFT)
Place = tuple[tuple[int, int], str, str]
Name = tuple[Point, str, Sequence[Place]]  # the point that has it, its color, places in order
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
    """Draw the front as a line and the other points faded, each with its name.

    The name of a faded point is left out if there is no room for it.

    Args:
        points: at least one.
        better: "higher" or "lower", of the quality.
        color: color of the front.
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
    names: list[Name] = []
    for point in front:
        first = ABOVE_RIGHT if point == front[-1] else ABOVE_LEFT
        names.append((point, INK, (first, LEFT, RIGHT, BELOW, first)))
    draw_names(axes, names + [(point, FAINT, AROUND) for point in rest], FONT)


def draw_names(axes: Axes, names: Sequence[Name], font: float | int) -> None:
    """Write names beside their points, the first ones first, each at its first place with room.

    A name without room is left out, unless its last place repeats an earlier one.
    """
    axes.figure.draw_without_rendering()  # fixes the points' places in pixels
    occupied = []
    for (name, *position), ink, places in names:
        for number, place in enumerate(places):
            offset, ha, va = place
            text = axes.annotate(
                name, position, offset, textcoords="offset points", ha=ha, va=va, color=ink,
                fontsize=font,
            )  # fmt: skip
            box = text.get_window_extent()
            if not any(map(box.overlaps, occupied)) or place in places[:number]:
                occupied.append(box)
                break
            text.remove()
