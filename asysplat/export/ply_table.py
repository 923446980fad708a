"""The vertices of a PLY file, ASCII, little-endian or big-endian, as a structured array.

Format: http://paulbourke.net/dataformats/ply
"""

import warnings
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy import ndarray

from asysplat.errors import InputError

BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"}
TYPES |= {"uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
MAX_LINE = 4096  # bytes of a header's line: other files may have no lines


class Element(NamedTuple):
    """One kind of rows, as declared by the header: numpy's type by property, None for a list."""

    name: str
    count: int
    types: dict[str, str | None]

    def row(self, byte_order: str) -> np.dtype:
        """Return the type of a row."""
        return np.dtype([(name, byte_order + kind) for name, kind in self.types.items()])


def read_vertices(path: Path) -> ndarray:
    """Read all vertices: [N], with a field for each property.

    Raises:
        InputError: not a PLY file, a truncated one, or one without vertices or with lists before or
            in them.
    """
    with open(path, "rb") as file:
        byte_order, elements = _read_header(file, path)
        vertex = _find_vertices(file, path, byte_order, elements)
        row = vertex.row(byte_order)
        # Before allocating: a damaged header may declare any number.
        left = path.stat().st_size - file.tell()
        smallest = row.itemsize if byte_order else 2 * len(row)
        if vertex.count * smallest > left + (not byte_order):
            raise _truncated(path, vertex.count, f"{left} bytes")
        if byte_order:
            return np.fromfile(file, row, vertex.count)
        try:
            with warnings.catch_warnings():  # of no line at all
                warnings.simplefilter("ignore", UserWarning)
                rows = np.loadtxt(file, row, comments=None, max_rows=vertex.count, ndmin=1)
        except ValueError as error:
            raise InputError(
                f"{path} has a vertex that cannot be read ({error}): expected {len(row)} numbers "
                "a line."
            ) from error
    if len(rows) < vertex.count:
        raise _truncated(path, vertex.count, f"{len(rows)} lines")
    return rows


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[Element]]:
    """Read the byte order and all elements."""
    if file.readline(MAX_LINE).strip() != b"ply":
        raise InputError(f"{path} is not a PLY file: expected 'ply' as its first line.")
    byte_order, elements = None, []
    while (line := file.readline(MAX_LINE)).strip() != b"end_header":
        match line.decode("latin-1").split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in BYTE_ORDERS:
                byte_order = BYTE_ORDERS[name]
            case ["element", name, count] if count.isdecimal():
                elements.append(Element(name, int(count), {}))
            case ["property", "list", _, _, name] if elements:
                elements[-1].types[name] = None
            case ["property", kind, name] if (
                kind in TYPES and elements and name not in elements[-1].types
            ):
                elements[-1].types[name] = TYPES[kind]
            case words:
                found = repr(" ".join(words)[:80]) if line else "no end_header"
                raise InputError(
                    f"{path} has {found} in its header: expected format, element, property and "
                    "end_header as PLY 1.0 has them; write it again."
                )
    if byte_order is None:
        raise InputError(f"{path} has no format in its header: expected {', '.join(BYTE_ORDERS)}.")
    return byte_order, elements


def _find_vertices(file: BinaryIO, path: Path, byte_order: str, elements: list[Element]) -> Element:
    """Seek from the header's end to the first vertex."""
    for element in elements:
        if None in element.types.values():
            raise InputError(
                f"{path} has a list in its element {element.name}: expected vertices of single "
                "numbers, and no lists before them."
            )
        if element.name == "vertex":
            break
        if byte_order:
            file.seek(element.count * element.row(byte_order).itemsize, 1)
        else:
            next(islice(file, element.count, element.count), None)
    else:
        raise InputError(f"{path} has no element vertex in its header: expected one.")
    if element.count == 0 or not element.types:
        raise InputError(f"{path} has no vertices: expected one or more, with properties.")
    return element


def _truncated(path: Path, count: int, found: str) -> InputError:
    return InputError(
        f"{path} is cut off: its header declares {count} vertices, but {found} follow; copy it "
        "again."
    )
