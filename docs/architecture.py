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
FIGURE = REPO / "docs" / "architecture.svg"

# Data flow: the package that returns a value, the value's type, the package that takes it.
FLOW = (
    ("data", "Views", "models"),
    ("models", "Gaussians", "rendering"),
    ("rendering", "Rendering", "evaluation"),
)

WIDTH, HEIGHT, GAP_X, GAP_Y, MARGIN, TOP = 230, 100, 104, 66, 126, 30  # in pixels
INK, FAINT, PAPER, FLOW_INK = "#22303c", "#9aa7b2", "#f6f3ec", "#d1622b"


@dataclass(frozen=True)
class Unit:
    """A package of asysplat, a module directly in it, or the scripts."""

    name: str
    files: tuple[Path, ...]

    @property
    def purpose(self) -> str:
        """Return the first paragraph of its docstring."""
        if self.name == "scripts":
            return ", ".join(path.name for path in self.files)
        first = next((p for p in self.files if p.name == "__init__.py"), self.files[0])
        return (ast.get_docstring(parse(first)) or "").split("\n\n")[0].replace("\n", " ")


@cache
def parse(path: Path) -> ast.Module:
    """Read a file's syntax tree."""
    return ast.parse(path.read_text())


def find_units() -> dict[str, Unit]:
    """Return all units of asysplat, by name."""
    units = {}
    for path in sorted(PACKAGE.iterdir()):
        if path.is_dir() and (path / "__init__.py").exists():
            units[path.name] = Unit(path.name, tuple(sorted(path.rglob("*.py"))))
        elif path.suffix == ".py" and path.stem != "__init__":
            units[path.stem] = Unit(path.stem, (path,))
    return units | {"scripts": Unit("scripts", tuple(sorted(REPO.glob("*.py"))))}


def count_imports(units: dict[str, Unit]) -> Counter[tuple[str, str]]:
    """Count the import statements from unit to unit."""
    counts = Counter()
    for unit in units.values():
        for path in unit.files:
            for node in ast.walk(parse(path)):
                if isinstance(node, ast.ImportFrom) and node.module:
                    package, _, rest = node.module.partition(".")
                    target = rest.split(".")[0]
                    if package == "asysplat" and target in units and target != unit.name:
                        counts[unit.name, target] += 1
    return counts


def find_layers(units: dict[str, Unit], imports: Counter[tuple[str, str]]) -> dict[str, int]:
    """Return each unit's layer: one above the highest unit it imports from."""
    layers: dict[str, int] = {}

    def layer(name: str, path: tuple[str, ...] = ()) -> int:
        if name in path:
            raise SystemExit(f"units import each other: {' -> '.join((*path, name))}")
        if name not in layers:
            below = [to for start, to in imports if start == name]
            layers[name] = max((layer(to, (*path, name)) + 1 for to in below), default=0)
        return layers[name]

    for name in units:
        layer(name)
    return layers


def direct_imports(imports: Counter[tuple[str, str]]) -> list[tuple[str, str]]:
    """Drop an import if a chain of other imports leads to the same unit."""

    def reaches(start: str, goal: str) -> bool:
        return any(to == goal or reaches(to, goal) for a, to in imports if a == start)

    def is_indirect(start: str, goal: str) -> bool:
        return any(a == start and to != goal and reaches(to, goal) for a, to in imports)

    return sorted(edge for edge in imports if not is_indirect(*edge))


def check_flow(units: dict[str, Unit]) -> None:
    """Check each step of FLOW against the function signatures of the two units."""
    for source, value, target in FLOW:
        returned = any(value in gives for _, gives in signatures(units[source]))
        accepted = any(value in takes for takes, _ in signatures(units[target]))
        if not (returned and accepted):
            raise SystemExit(
                f"no function of {source} returns {value}, or none of {target} takes it"
            )


def signatures(unit: Unit) -> list[tuple[set[str], set[str]]]:
    """Return the type names in each function's annotations: of arguments, of return values."""

    def names(annotations: list[ast.expr | None]) -> set[str]:
        nodes = [node for a in annotations if a is not None for node in ast.walk(a)]
        return {node.id for node in nodes if isinstance(node, ast.Name)}

    functions = [
        node
        for path in unit.files
        for node in ast.walk(parse(path))
        if isinstance(node, ast.FunctionDef)
    ]
    return [(names([a.annotation for a in f.args.args]), names([f.returns])) for f in functions]


def find_rows(layers: dict[str, int], imports: Counter[tuple[str, str]]) -> list[list[str]]:
    """Return the rows of the figure: units above the flow, in the flow, and below it."""
    flow = [FLOW[0][0], *(target for *_, target in FLOW)]
    above = {unit for unit in layers if all_imports(unit, imports) & {*flow}} - {*flow}
    # Imports of the flow are drawn below it, even if they import another unit in the flow.
    above -= {to for unit in flow for to in all_imports(unit, imports)}
    below = {*layers} - {*flow} - above
    rows: list[list[str]] = [
        ["scripts"],
        sorted(above - {"scripts"}, key=lambda r: (layers[r], r)),
        flow,
    ]
    rows.append(sorted((unit for unit in below if layers[unit]), key=lambda r: (-layers[r], r)))
    return [*rows, sorted(unit for unit in below if not layers[unit])]


def all_imports(unit: str, imports: Counter[tuple[str, str]]) -> set[str]:
    """Return all units that a unit imports from, directly or indirectly."""
    direct = {to for start, to in imports if start == unit}
    return direct.union(*(all_imports(to, imports) for to in direct))


def place(rows: list[list[str]]) -> dict[str, tuple[float, float]]:
    """Return the upper left corner of every unit, row by row, each row centered."""
    widest = max(map(len, rows))
    return {
        name: (MARGIN + ((widest - len(row)) / 2 + i) * (WIDTH + GAP_X), TOP + y * (HEIGHT + GAP_Y))
        for y, row in enumerate(rows)
        for i, name in enumerate(row)
    }


def draw_unit(unit: Unit, x: float, y: float, in_flow: bool) -> str:
    """Draw a box with a unit's name and purpose."""
    edge = FLOW_INK if in_flow else FAINT
    lines = [
        f'<rect x="{x:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="6" fill="white" '
        f'stroke="{edge}" stroke-width="{2.4 if in_flow else 1.2}"/>',
        text(x + 12, y + 23, unit.name, 16, INK, "bold"),
    ]
    for i, line in enumerate(wrap(unit.purpose, 33)[:4]):
        lines.append(text(x + 12, y + 43 + 16 * i, line, 11.5, INK))
    return "\n".join(lines)


def draw_import(start: tuple[float, float], end: tuple[float, float]) -> str:
    """Draw an arrow from a unit to an imported unit below or beside it."""
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
    """Draw the value that a unit passes to the next, in the gap between them."""
    y += 0.4 * HEIGHT
    return (
        f'<path d="M{x + 4:g},{y:g} H{x + GAP_X - 5:g}" stroke="{FLOW_INK}" stroke-width="4" '
        'marker-end="url(#value)"/>'
    ) + text(x + GAP_X / 2, y - 12, name, 14, FLOW_INK, "bold", "middle")


def text(
    x: float, y: float, words: str, size: float, ink: str, weight: str = "normal", anchor="start"
) -> str:
    """Write one line."""
    return (
        f'<text x="{x:g}" y="{y:g}" font-size="{size}" fill="{ink}" font-weight="{weight}" '
        f'text-anchor="{anchor}">{escape(words)}</text>'
    )


def draw() -> str:
    """Return the figure as SVG.

    Raises:
        SystemExit: units that import each other, or a step of FLOW without a matching signature.
    """
    units = find_units()
    check_flow(units)
    imports = count_imports(units)
    corners = place(find_rows(find_layers(units, imports), imports))
    flow = [FLOW[0][0], *(target for *_, target in FLOW)]
    values = ["photographs", *(value for _, value, _ in FLOW), "metrics"]
    first_x, flow_y = corners[flow[0]]
    width = max(x for x, _ in corners.values()) + WIDTH + MARGIN
    bottom = max(y for _, y in corners.values()) + HEIGHT
    note = "Thin arrows are imports, without those that follow from others."
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {bottom + 50:g}" '
            'font-family="Helvetica, Arial, sans-serif">',
            f"<defs>{marker('import', 8, FAINT)}{marker('value', 4, FLOW_INK)}</defs>",
            f'<rect width="100%" height="100%" fill="{PAPER}"/>',
            *(draw_import(corners[a], corners[b]) for a, b in direct_imports(imports)),
            *(draw_unit(unit, *corners[unit.name], unit.name in flow) for unit in units.values()),
            *(
                draw_value(value, first_x + i * (WIDTH + GAP_X) - GAP_X, flow_y)
                for i, value in enumerate(values)
            ),
            text(width / 2, bottom + 30, note, 12, INK, anchor="middle"),
            "</svg>\n",
        ]
    )


def marker(name: str, size: float, ink: str) -> str:
    """Define an arrow head; its size is in line widths."""
    return (
        f'<marker id="{name}" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="{size}" '
        f'markerHeight="{size}" orient="auto"><path d="M0,0 L8,4 L0,8 Z" fill="{ink}"/></marker>'
    )


def describe() -> str:
    """Count the layers, from the scripts down, and the lines of asysplat."""
    units = find_units()
    layers = find_layers(units, count_imports(units))
    lines = sum(len(path.read_text().splitlines()) for path in PACKAGE.rglob("*.py"))
    return f"{max(layers.values()) + 1} layers, {lines:,} lines"


if __name__ == "__main__":
    FIGURE.write_text(draw())
    print(f"{FIGURE}: {describe()}")
