"""Draw docs/architecture.svg from asysplat's imports and signatures.

python docs/architecture.py
"""

import ast
from collections import Counter
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from textwrap import wrap

REPO = Path(__file__).resolve().parents[1]
PACKAGE = REPO / "asysplat"
PICTURE = REPO / "docs" / "architecture.svg"

# A photograph's way: the room that makes a value, the value's type, the room that takes it.
WAY = (
    ("data", "Views", "models"),
    ("models", "Gaussians", "rendering"),
    ("rendering", "Rendering", "evaluation"),
)

WIDTH, HEIGHT, GAP_X, GAP_Y, MARGIN, TOP = 230, 100, 104, 66, 126, 30  # in pixels
INK, FAINT, PAPER, WAY_INK = "#22303c", "#9aa7b2", "#f6f3ec", "#d1622b"


@dataclass(frozen=True)
class Room:
    """A package of asysplat, one of its modules, or the scripts beside it."""

    name: str
    files: tuple[Path, ...]

    @property
    def purpose(self) -> str:
        """Return the first sentence of what the room says of itself."""
        if self.name == "scripts":
            return ", ".join(path.name for path in self.files)
        first = next((p for p in self.files if p.name == "__init__.py"), self.files[0])
        return (ast.get_docstring(parse(first)) or "").split("\n\n")[0].replace("\n", " ")


@cache
def parse(path: Path) -> ast.Module:
    """Read a file's syntax tree."""
    return ast.parse(path.read_text())


def find_rooms() -> dict[str, Room]:
    """Return what asysplat consists of, by name."""
    rooms = {}
    for path in sorted(PACKAGE.iterdir()):
        if path.is_dir() and (path / "__init__.py").exists():
            rooms[path.name] = Room(path.name, tuple(sorted(path.rglob("*.py"))))
        elif path.suffix == ".py" and path.stem != "__init__":
            rooms[path.stem] = Room(path.stem, (path,))
    return rooms | {"scripts": Room("scripts", tuple(sorted(REPO.glob("*.py"))))}


def count_imports(rooms: dict[str, Room]) -> Counter[tuple[str, str]]:
    """Count the import statements from room to room."""
    counts = Counter()
    for room in rooms.values():
        for path in room.files:
            for node in ast.walk(parse(path)):
                if isinstance(node, ast.ImportFrom) and node.module:
                    package, _, rest = node.module.partition(".")
                    target = rest.split(".")[0]
                    if package == "asysplat" and target in rooms and target != room.name:
                        counts[room.name, target] += 1
    return counts


def find_floors(rooms: dict[str, Room], imports: Counter[tuple[str, str]]) -> dict[str, int]:
    """Return each room's floor: one above the highest room it imports from."""
    floors: dict[str, int] = {}

    def floor(name: str, path: tuple[str, ...] = ()) -> int:
        if name in path:
            raise SystemExit(f"rooms import each other: {' -> '.join((*path, name))}")
        if name not in floors:
            below = [to for start, to in imports if start == name]
            floors[name] = max((floor(to, (*path, name)) + 1 for to in below), default=0)
        return floors[name]

    for name in rooms:
        floor(name)
    return floors


def without_detours(imports: Counter[tuple[str, str]]) -> list[tuple[str, str]]:
    """Leave out an arrow where a longer way leads to the same room."""

    def reaches(start: str, goal: str) -> bool:
        return any(to == goal or reaches(to, goal) for a, to in imports if a == start)

    def has_detour(start: str, goal: str) -> bool:
        return any(a == start and to != goal and reaches(to, goal) for a, to in imports)

    return sorted(edge for edge in imports if not has_detour(*edge))


def check_way(rooms: dict[str, Room]) -> None:
    """Refuse a step of WAY that no signature in the two rooms bears out."""
    for maker, value, taker in WAY:
        made = any(value in gives for _, gives in signatures(rooms[maker]))
        taken = any(value in takes for takes, _ in signatures(rooms[taker]))
        if not (made and taken):
            raise SystemExit(f"no function of {maker} returns {value}, or none of {taker} takes it")


def signatures(room: Room) -> list[tuple[set[str], set[str]]]:
    """Return the names in each function's annotations: of what it takes, of what it returns."""

    def names(annotations: list[ast.expr | None]) -> set[str]:
        nodes = [node for a in annotations if a is not None for node in ast.walk(a)]
        return {node.id for node in nodes if isinstance(node, ast.Name)}

    functions = [
        node
        for path in room.files
        for node in ast.walk(parse(path))
        if isinstance(node, ast.FunctionDef)
    ]
    return [(names([a.annotation for a in f.args.args]), names([f.returns])) for f in functions]


def find_rows(floors: dict[str, int], imports: Counter[tuple[str, str]]) -> list[list[str]]:
    """Return the rows of the picture: who calls the rooms on the way, these, what they stand on."""
    way = [WAY[0][0], *(taker for *_, taker in WAY)]
    above = {room for room in floors if reached(room, imports) & {*way}} - {*way}
    # What a room on the way imports stands below it, even if it imports another one itself.
    above -= {to for room in way for to in reached(room, imports)}
    below = {*floors} - {*way} - above
    rows: list[list[str]] = [
        ["scripts"],
        sorted(above - {"scripts"}, key=lambda r: (floors[r], r)),
        way,
    ]
    rows.append(sorted((room for room in below if floors[room]), key=lambda r: (-floors[r], r)))
    return [*rows, sorted(room for room in below if not floors[room])]


def reached(room: str, imports: Counter[tuple[str, str]]) -> set[str]:
    """Return all rooms that a room imports from, directly or through others."""
    direct = {to for start, to in imports if start == room}
    return direct.union(*(reached(to, imports) for to in direct))


def place(rows: list[list[str]]) -> dict[str, tuple[float, float]]:
    """Return the upper left corner of every room, row by row, each row in the middle."""
    widest = max(map(len, rows))
    return {
        name: (MARGIN + ((widest - len(row)) / 2 + i) * (WIDTH + GAP_X), TOP + y * (HEIGHT + GAP_Y))
        for y, row in enumerate(rows)
        for i, name in enumerate(row)
    }


def draw_room(room: Room, x: float, y: float, on_way: bool) -> str:
    """Draw a box with a room's name and purpose."""
    edge = WAY_INK if on_way else FAINT
    lines = [
        f'<rect x="{x:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="6" fill="white" '
        f'stroke="{edge}" stroke-width="{2.4 if on_way else 1.2}"/>',
        text(x + 12, y + 23, room.name, 16, INK, "bold"),
    ]
    for i, line in enumerate(wrap(room.purpose, 33)[:4]):
        lines.append(text(x + 12, y + 43 + 16 * i, line, 11.5, INK))
    return "\n".join(lines)


def draw_import(start: tuple[float, float], end: tuple[float, float]) -> str:
    """Draw an arrow from a room to one that it imports from, below it or beside it."""
    (x0, y0), (x1, y1) = start, end
    if y0 == y1:
        side = WIDTH if x1 > x0 else 0
        y = y0 + 0.75 * HEIGHT
        line = f"M{x0 + side:g},{y:g} H{x1 + WIDTH - side:g}"
    else:
        down = HEIGHT if y1 > y0 else 0
        x0, y0, x1, y1 = x0 + WIDTH / 2, y0 + down, x1 + WIDTH / 2, y1 + HEIGHT - down
        middle = (y0 + y1) / 2
        line = f"M{x0:g},{y0:g} C{x0:g},{middle:g} {x1:g},{middle:g} {x1:g},{y1:g}"
    return (
        f'<path d="{line}" fill="none" stroke="{FAINT}" stroke-width="1.3" '
        'marker-end="url(#import)"/>'
    )


def draw_value(name: str, x: float, y: float) -> str:
    """Draw what passes from a room to the next one on the way, in the gap between them."""
    y += 0.4 * HEIGHT
    return (
        f'<path d="M{x + 4:g},{y:g} H{x + GAP_X - 5:g}" stroke="{WAY_INK}" stroke-width="4" '
        'marker-end="url(#value)"/>'
    ) + text(x + GAP_X / 2, y - 12, name, 14, WAY_INK, "bold", "middle")


def text(
    x: float, y: float, words: str, size: float, ink: str, weight: str = "normal", anchor="start"
) -> str:
    """Write one line."""
    return (
        f'<text x="{x:g}" y="{y:g}" font-size="{size}" fill="{ink}" font-weight="{weight}" '
        f'text-anchor="{anchor}">{escape(words)}</text>'
    )


def draw() -> str:
    """Return the whole picture as SVG.

    Raises:
        SystemExit: rooms that import each other, a step of WAY that the code does not bear out.
    """
    rooms = find_rooms()
    check_way(rooms)
    imports = count_imports(rooms)
    corners = place(find_rows(find_floors(rooms, imports), imports))
    way = [WAY[0][0], *(taker for *_, taker in WAY)]
    values = ["photographs", *(value for _, value, _ in WAY), "metrics"]
    first_x, way_y = corners[way[0]]
    width = max(x for x, _ in corners.values()) + WIDTH + MARGIN
    bottom = max(y for _, y in corners.values()) + HEIGHT
    note = "A thin arrow is an import; it is left out where a longer way leads to the same room."
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {bottom + 50:g}" '
            'font-family="Helvetica, Arial, sans-serif">',
            f"<defs>{marker('import', 8, FAINT)}{marker('value', 4, WAY_INK)}</defs>",
            f'<rect width="100%" height="100%" fill="{PAPER}"/>',
            *(draw_import(corners[a], corners[b]) for a, b in without_detours(imports)),
            *(draw_room(room, *corners[room.name], room.name in way) for room in rooms.values()),
            *(
                draw_value(value, first_x + i * (WIDTH + GAP_X) - GAP_X, way_y)
                for i, value in enumerate(values)
            ),
            text(width / 2, bottom + 30, note, 12, INK, anchor="middle"),
            "</svg>\n",
        ]
    )


def marker(name: str, size: float, ink: str) -> str:
    """Define the head of an arrow; its size is in widths of the line."""
    return (
        f'<marker id="{name}" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="{size}" '
        f'markerHeight="{size}" orient="auto"><path d="M0,0 L8,4 L0,8 Z" fill="{ink}"/></marker>'
    )


if __name__ == "__main__":
    PICTURE.write_text(draw())
    print(PICTURE)
