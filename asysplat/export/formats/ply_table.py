"""The elements of a PLY file, ASCII, little-endian or big-endian, as structured arrays.

Format: http://paulbourke.net/dataformats/ply
"""

import warnings
from collections.abc import Collection
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


def read_elements(path: Path, names: Collection[str]) -> dict[str, ndarray]:
    """Read the elements with these names, among them the vertices: rows [N] of fields.

    An element that the file does not have is left out.
    """
    with open(path, "rb") as file:
        byte_order, elements = _read_header(file, path)
        declared = [name for name, _, _ in elements]
        if "vertex" not in declared:
            raise InputError(f"{path} has no element vertex in its header: expected one.")
        last = max(index for index, name in enumerate(declared) if name in names)
        tables = {}
        for name, count, types in elements[: last + 1]:
            if None in types.values():
                raise InputError(
                    f"{path} has a list in its element {name}: expected vertices of single "
                    "numbers, and no lists before them."
                )
            row = np.dtype([(key, byte_order + kind) for key, kind in types.items()])
            if name in names:
                tables[name] = _read_rows(file, path, name, count, row, text=not byte_order)
            elif count > path.stat().st_size:
                raise _cut_off(path, count, name, "fewer bytes")
            elif byte_order:
                file.seek(count * row.itemsize, 1)
            else:
                next(islice(file, count, count), None)
    return tables


def _read_rows(
    file: BinaryIO, path: Path, name: str, count: int, row: np.dtype, text: bool
) -> ndarray:
    """Read the rows of one element, which begin where the file stands."""
    if count == 0 or not row.names:
        raise InputError(f"{path} has no {_plural(name)}: expected one or more, with properties.")
    # Before allocating: a damaged header may declare any number.
    remaining = path.stat().st_size - file.tell()
    smallest = 2 * len(row) if text else row.itemsize
    if count * smallest > remaining + text:
        raise _cut_off(path, count, name, f"{remaining} bytes")
    if not text:
        return np.fromfile(file, row, count)
    lines = islice(file, count)
    try:
        with warnings.catch_warnings():  # loadtxt warns if no line is left
            warnings.simplefilter("ignore", UserWarning)
            rows = np.loadtxt(lines, row, comments=None, ndmin=1)
    except ValueError as error:
        raise InputError(
            f"{path} has a {name} that cannot be read ({error}): expected {len(row)} "
            "numbers a line."
        ) from error
    if len(rows) < count:
        raise _cut_off(path, count, name, f"{len(rows)} lines")
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


def _plural(name: str) -> str:
    return "vertices" if name == "vertex" else f"rows of {name}"


def _cut_off(path: Path, count: int, name: str, rest: str) -> InputError:
    return InputError(
        f"{path} is cut off: its header declares {count} {_plural(name)}, but {rest} follow; copy "
        "it again."
    )
