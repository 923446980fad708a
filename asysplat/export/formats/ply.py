"""Gaussians as PLY, in the layout of Kerbl et al. 2023 that trainers and viewers share.

A vertex is a Gaussian with float32 properties: the mean, an unused normal, SH (degree 0, then the
other degrees of red, of green and of blue), the opacity's logit, log scales, a quaternion wxyz.
"""

import math
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy import ndarray
from numpy.lib.recfunctions import structured_to_unstructured

from asysplat.errors import InputError
from asysplat.export.formats import compressed_ply
from asysplat.export.formats.packing import TINY, prepare_for_export, reading
from asysplat.files import atomic_write
from asysplat.scene import Gaussians

MEAN, NORMAL, COLOR = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALE, ROTATION = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"}
TYPES |= {"uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
ELEMENTS = ("chunk", "vertex", "sh")  # of Gaussians, the first and the last if compressed
MAX_HEADER = 65536  # bytes in which comments are searched
MAX_OPACITY = 1 - 1e-7  # the logit of 1 is infinite


def write_ply(
    path: str | Path,
    gaussians: Gaussians,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
    background: Sequence[float] = (),
    antialiased: bool = False,
) -> None:
    """Write one scene, without batch dimension, as binary little-endian PLY.

    Quaternions are normalized, and an opacity of 1 is written as 1 - 1e-7. Comments say what a
    renderer needs to know: `antialiased 0` or `1`, and `sh_degree`.

    Args:
        offset: to be added to the means, which float32 may not resolve: written as a comment,
            `comment offset X Y Z`, if it is not 0.
        background: RGB in [0, 1] behind the Gaussians, if known: written as a comment likewise.
        antialiased: as for `render`.
    """
    gaussians = prepare_for_export(gaussians)
    opacities = gaussians.opacities.double().clamp_max(MAX_OPACITY)
    columns = (
        gaussians.means,
        torch.zeros_like(gaussians.means),
        gaussians.sh[:, 0],
        gaussians.sh[:, 1:].mT.flatten(1),
        opacities.logit()[:, None].float(),
        gaussians.scales.double().log().float(),
        torch.nn.functional.normalize(gaussians.quats.double(), dim=-1).float(),
    )
    table = torch.cat(columns, 1).numpy().astype("<f4", copy=False)
    rest = _rest(3 * (gaussians.sh.shape[1] - 1))
    names = [*MEAN, *NORMAL, *COLOR, *rest, "opacity", *SCALE, *ROTATION]
    header = ["ply", "format binary_little_endian 1.0"]
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    comments = {"antialiased": (int(antialiased),), "sh_degree": (degree,)}
    comments |= {"background": background, "offset": offset if any(offset) else ()}
    header += [f"comment {k} {' '.join(map(repr, v))}" for k, v in comments.items() if v]
    header += [f"element vertex {len(table)}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    with atomic_write(path) as partial, open(partial, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.data)


def read_ply(path: str | Path) -> Gaussians:
    """Read one scene from PLY of any byte order, ASCII or compressed; properties in any order."""
    with reading(path, "PLY") as path:
        elements = _read_elements(path)
        vertices = elements["vertex"]
        properties = vertices.dtype.names
        if compressed_ply.PACKED[0] in properties:
            return compressed_ply.unpack(elements).validate()
        count = sum(name.startswith("f_rest_") for name in properties)
        names = [*MEAN, *COLOR, *_rest(count), "opacity", *SCALE, *ROTATION]
        if missing := [name for name in names if name not in properties]:
            raise InputError(f"no property {missing[0]}, which 3D Gaussians have.")
        columns = torch.from_numpy(structured_to_unstructured(vertices[names], np.float32))
        means, color, rest, logits, scales, quats = columns.split((3, 3, count, 1, 3, 4), 1)
        return Gaussians(
            means=means.contiguous(),
            quats=quats.contiguous(),
            scales=scales.double().exp().float().clamp_min(TINY),
            opacities=logits[:, 0].double().sigmoid().float().clamp_min(TINY),
            sh=torch.cat((color[:, None], rest.unflatten(1, (3, count // 3)).mT), 1),
        ).validate()


def _read_elements(path: Path) -> dict[str, ndarray]:
    """Read the elements that Gaussians need, among them the vertices: rows [N] of fields.

    Format: http://paulbourke.net/dataformats/ply
    """
    with open(path, "rb") as file:
        byte_order, elements = _read_header(file)
        last = max((i for i, (name, _, _) in enumerate(elements) if name in ELEMENTS), default=-1)
        tables = {}
        for name, count, types in elements[: last + 1]:
            row = np.dtype([(key, byte_order + kind) for key, kind in types.items()])
            if byte_order:
                rows = np.fromfile(file, row, count)
            else:
                rows = np.loadtxt(islice(file, count), row, comments=None, ndmin=1)
            if len(rows) < count:
                raise InputError(f"it is cut short: {len(rows)} of {count} rows of {name}.")
            tables[name] = rows
    if not len(tables.get("vertex", ())):
        raise InputError("it has no vertices: expected one or more.")
    return tables


def _read_header(file: BinaryIO) -> tuple[str, list[tuple[str, int, dict[str, str]]]]:
    """Read the byte order, and of each element the name, the rows and the type by property."""
    if file.readline().strip() != b"ply":
        raise InputError("expected 'ply' as its first line.")
    byte_order, elements = "", []
    while (line := file.readline()).strip() != b"end_header":
        match line.decode("latin-1").split():
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"]:
                byte_order = BYTE_ORDERS[name]
            case ["element", name, count]:
                elements.append((name, int(count), {}))
            case ["property", kind, name]:
                elements[-1][2][name] = TYPES[kind]
            case ["property", "list", _, _, name]:  # lists of faces, which follow the vertices
                elements[-1][2][name] = "O"
            case words:
                raise InputError(f"{' '.join(words)[:80] or 'its end'!r} stands in its header.")
    return byte_order, elements


def read_comment(path: str | Path, name: str) -> str:
    """Read the rest of the line `comment <name>` of a PLY file; "" where it has none."""
    with reading(path, "PLY") as path, open(path, "rb") as file:
        header = file.read(MAX_HEADER).partition(b"end_header")[0].decode("latin-1")
    start = f"comment {name} "
    return next((line[len(start) :] for line in header.split("\n") if line.startswith(start)), "")


def _rest(count: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(count)]
