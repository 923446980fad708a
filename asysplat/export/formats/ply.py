"""Gaussians as PLY, in the layout of Kerbl et al. 2023 that trainers and viewers share.

A vertex is a Gaussian with float32 properties: the mean, an unused normal, SH (degree 0, then the
other degrees of red, of green and of blue), the opacity's logit, log scales, a quaternion wxyz.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.lib.recfunctions import structured_to_unstructured

from asysplat.errors import InputError
from asysplat.export.formats import compressed_ply
from asysplat.export.formats.packing import TINY, prepare_for_export, require_file
from asysplat.export.formats.ply_table import read_elements
from asysplat.files import atomic_write
from asysplat.scene import Gaussians

MEAN, NORMAL, COLOR = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
SCALE, ROTATION = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
REST_COUNTS = (0, 9, 24, 45)  # numbers of properties f_rest_*, for SH of degree 0 to 3
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
        path: the file.
        gaussians: [N].
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
    comments = {
        "antialiased": (int(antialiased),),
        "sh_degree": (degree,),
        "background": background,
    }
    comments |= {"offset": offset} if any(offset) else {}
    header += [f"comment {k} {' '.join(map(repr, v))}" for k, v in comments.items() if v]
    header += [f"element vertex {len(table)}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    with atomic_write(path) as partial, open(partial, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.data)


def read_ply(path: str | Path) -> Gaussians:
    """Read one scene from PLY, little-endian, big-endian, ASCII or compressed, in float32.

    Properties may have any order; unknown ones are ignored.
    """
    path = require_file(path)
    elements = read_elements(path, compressed_ply.ELEMENTS)
    vertices = elements["vertex"]
    properties = vertices.dtype.names
    if compressed_ply.PACKED[0] in properties:
        return compressed_ply.unpack(path, elements)
    count = sum(name.startswith("f_rest_") for name in properties)
    if count not in REST_COUNTS:
        raise InputError(
            f"{path} has {count} properties f_rest_*: expected "
            f"{', '.join(map(str, REST_COUNTS))} (SH of degree 0 to 3)."
        )
    names = [*MEAN, *COLOR, *_rest(count), "opacity", *SCALE, *ROTATION]
    missing = [name for name in names if name not in properties]
    if missing:
        raise InputError(
            f"{path} has no property {missing[0]}: expected the properties of 3D Gaussians, "
            f"{', '.join(name for name in names if 'rest' not in name)}."
        )
    table = structured_to_unstructured(vertices[names], np.float32)
    finite = np.isfinite(table)
    if not finite.all():
        row, column = np.argwhere(~finite)[0]
        raise InputError(
            f"{path}: {names[column]} of vertex {row} is {table[row, column]}: repair or remove "
            "that vertex."
        )
    columns = torch.from_numpy(table).split((3, 3, count, 1, 3, 4), 1)
    means, color, rest, logits, scales, quats = columns
    gaussians = Gaussians(
        means=means.contiguous(),
        quats=quats.contiguous(),
        scales=scales.double().exp().float().clamp_min(TINY),
        opacities=logits[:, 0].double().sigmoid().float().clamp_min(TINY),
        sh=torch.cat((color[:, None], rest.unflatten(1, (3, count // 3)).mT), 1),
    )
    return gaussians.validate(f"{path}: Gaussians")


def read_comment(path: str | Path, name: str) -> str:
    """Read the rest of the line `comment <name>` of a PLY file; "" where it has none."""
    with open(path, "rb") as file:
        header = file.read(MAX_HEADER).partition(b"end_header")[0].decode("latin-1")
    start = f"comment {name} "
    return next((line[len(start) :] for line in header.split("\n") if line.startswith(start)), "")


def _rest(count: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(count)]
