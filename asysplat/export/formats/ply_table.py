"""The vertices of a PLY file, ASCII, little-endian or big-endian, as a structured array.

Format: http://paulbourke.net/dataformats/ply
"""

import warnings
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy import ndarray

from asysplat.errors import InputError

BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"}
TYPES |= {"uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
MAX_LINE = 4096  # bytes of a header's line: other files may have no lines
# An element as the header declares it: name, number of rows, and numpy's type by property,
# None for a list.
Element = tuple[str, int, dict[str, str | None]]


def read_vertices(path: Path) -> ndarray:
    """Read all vertices: [N], with a field for each property.

    Raises:
        InputError: not a PLY file, a truncated one, or one without vertices or with lists before or
            in them.
    """
    with open(path, "rb") as file:
        byte_order, elements = _read_header(file, path)
        for name, count, types in elements:
            if None in types.values():
                raise InputError(
                    f"{path} has a list in its element {name}: expected vertices of single "
                    "numbers, and no lists before them."
                )
            row = np.dtype([(key, byte_order + kind) for key, kind in types.items()])
            if name == "vertex":
                break
            if count > path.stat().st_size:
                raise _truncated(path, count, "fewer bytes", f"rows of {name}")
            if byte_order:
                file.seek(count * row.itemsize, 1)
            else:
                next(islice(file, count, count), None)
        else:
            raise InputError(f"{path} has no element vertex in its header: expected one.")
        if count == 0 or not types:
            raise InputError(f"{path} has no vertices: expected one or more, with properties.")
        # Before allocating: a damaged header may declare any number.
        remaining = path.stat().st_size - file.tell()
        smallest = row.itemsize if byte_order else 2 * len(row)
        if count * smallest > remaining + (not byte_order):
            raise _truncated(path, count, f"{remaining} bytes")
        if byte_order:
            return np.fromfile(file, row, count)
        try:
            with warnings.catch_warnings():  # loadtxt warns if no line is left
                warnings.simplefilter("ignore", UserWarning)
                rows = np.loadtxt(file, row, comments=None, max_rows=count, ndmin=1)
        except ValueError as error:
            raise InputError(
                f"{path} has a vertex that cannot be read ({error}): expected {len(row)} numbers "
                "a line."
            ) from error
    if len(rows) < count:
        raise _truncated(path, count, f"{len(rows)} lines")
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
                types = {}
                elements.append((name, int(count), types))
            case ["property", "list", _, _, name] if elements:
                types[name] = None
            case ["property", kind, name] if elements and kind in TYPES and name not in types:
                types[name] = TYPES[kind]
            case words:
                text = repr(" ".join(words)[:80]) if line else "no end_header"
                raise InputError(
                    f"{path} has {text} in its header: expected format, element, property and "
                    "end_header as PLY 1.0 has them; write it again."
                )
    if byte_order is None:
        raise InputError(f"{path} has no format in its header: expected {', '.join(BYTE_ORDERS)}.")
    return byte_order, elements


def _truncated(path: Path, count: int, rest: str, kind: str = "vertices") -> InputError:
    return InputError(
        f"{path} is cut off: its header declares {count} {kind}, but {rest} follow; copy it again."
    )
