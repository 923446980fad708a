"""Gaussians as PlayCanvas's compressed PLY: 16 bytes each, and one for each number of SH above 0.

256 Gaussians share a range of positions, of log scales and of colors, in which their numbers are
stored with 8 to 11 bits.
Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt32
from numpy import ndarray
from numpy.lib.recfunctions import structured_to_unstructured

from asysplat.export.formats import packing
from asysplat.files import atomic_write
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.scene import Gaussians

CHUNK = 256  # Gaussians that share their ranges
RANGES = [
    f"{end}_{axis}"
    for axes in (["x", "y", "z"], ["scale_x", "scale_y", "scale_z"], ["r", "g", "b"])
    for end in ("min", "max")
    for axis in axes
]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
BITS = ((11, 10, 11), (2, 10, 10, 10), (11, 10, 11), (8, 8, 8, 8))  # of the numbers in PACKED
MAX_LOG_SCALE = 20
SH_RANGE = 8  # from -4 to 4, in 256 steps


def write_compressed_ply(path: str | Path, gaussians: Gaussians, antialiased: bool = False) -> None:
    """Write one scene, without batch dimension, as compressed PLY.

    Gaussians are ordered along a Z-order curve, so that those of a range are near each other. A
    comment tells whether they are to be rendered `antialiased`.
    """
    scene = packing.in_morton_order(packing.prepare_for_export(gaussians))
    count, chunks = scene.num_gaussians, -(-scene.num_gaussians // CHUNK)
    log_scales = scene.scales.log().clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    values = torch.stack((scene.means, log_scales, 0.5 + SH_C0 * scene.sh[:, 0]), 1).numpy()
    # The last Gaussian fills the last chunk, which widens no range.
    filled = np.concatenate((values, values[-1:].repeat(chunks * CHUNK - count, 0)))
    filled = filled.reshape(chunks, CHUNK, 3, 3)
    ranges = np.stack((filled.min(1), filled.max(1)), 2).astype("<f4")
    low, extent = ranges[:, None, :, 0], ranges[:, None, :, 1] - ranges[:, None, :, 0]
    places = (filled - low) / np.where(extent > 0, extent, 1)
    position, scale, color = places.reshape(-1, 3, 3)[:count].transpose(1, 0, 2)
    largest, rest = (part.numpy() for part in packing.split_largest(scene.quats))
    rotation = np.concatenate((largest[:, None] / 3, rest * 0.5**0.5 + 0.5), 1)
    color = np.concatenate((color, scene.opacities[:, None].numpy()), 1)
    places = (position, rotation, scale, color)
    packed = [_pack(numbers, bits) for numbers, bits in zip(places, BITS, strict=True)]
    sh = scene.sh[:, 1:].mT.flatten(1).numpy()
    steps = np.floor((sh / SH_RANGE + 0.5) * 256).clip(0, 255).astype(np.uint8)
    header = ["ply", "format binary_little_endian 1.0", f"comment antialiased {int(antialiased)}"]
    header += [f"element chunk {chunks}", *(f"property float {name}" for name in RANGES)]
    header += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if steps.size:
        names = [f"f_rest_{i}" for i in range(steps.shape[1])]
        header += [f"element sh {count}", *(f"property uchar {name}" for name in names)]
    with atomic_write(path) as partial, open(partial, "wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        file.write(ranges.tobytes())
        file.write(np.stack(packed, 1).astype("<u4").tobytes())
        file.write(steps.tobytes())


def unpack(elements: dict[str, ndarray]) -> Gaussians:
    """Compute the Gaussians of a compressed PLY file from its elements chunk, vertex and sh."""
    vertices, chunks = elements["vertex"], elements["chunk"]
    names = RANGES if "min_r" in chunks.dtype.names else RANGES[:12]
    ranges = structured_to_unstructured(chunks[names], np.float32).reshape(len(chunks), -1, 2, 3)
    ranges = ranges[np.arange(len(vertices)) // CHUNK]
    (position, rotation, scale, color) = (
        _unpack(vertices[name].astype(np.uint32), bits)
        for name, bits in zip(PACKED, BITS, strict=True)
    )
    rgb = _within(ranges[:, 2], color[:, :3]) if len(names) == len(RANGES) else color[:, :3]
    sh = (torch.from_numpy(rgb) - 0.5).div(SH_C0).float()[:, None]
    if "sh" in elements:
        # The first and last step reach the ends of the range, the others stand for their middle.
        places = (torch.arange(256, dtype=torch.float64) + 0.5) / 256
        places[0], places[-1] = 0, 1
        rows = elements["sh"]
        rest = [f"f_rest_{i}" for i in range(len(rows.dtype.names))]
        steps = torch.from_numpy(structured_to_unstructured(rows[rest], np.uint8))
        values = (SH_RANGE * (places - 0.5)).float()
        sh = torch.cat((sh, values[steps.int()].unflatten(1, (3, -1)).mT), 1)
    largest = (3 * rotation[:, 0]).round().astype(np.int64)
    return Gaussians(
        means=torch.from_numpy(_within(ranges[:, 0], position)).float(),
        quats=packing.join_largest(largest, (rotation[:, 1:] - 0.5) * 2**0.5).float(),
        scales=torch.from_numpy(_within(ranges[:, 1], scale)).exp().float().clamp_min(packing.TINY),
        opacities=torch.from_numpy(color[:, 3]).float().clamp_min(packing.TINY),
        sh=sh,
    )


def _pack(places: Float[ndarray, "N k"], bits: Sequence[int]) -> UInt32[ndarray, "N"]:
    """Pack numbers in [0, 1] into 32 bits, the first in the highest."""
    packed = np.zeros(len(places), np.uint32)
    for column, count in zip(places.T, bits, strict=True):
        steps = (column * (2**count - 1) + 0.5).clip(0, 2**count - 1).astype(np.uint32)
        packed = packed << count | steps
    return packed


def _unpack(packed: UInt32[ndarray, "N"], bits: Sequence[int]) -> Float[ndarray, "N k"]:
    columns, shift = [], 32
    for count in bits:
        shift -= count
        columns.append((packed >> shift & 2**count - 1) / (2**count - 1))
    return np.stack(columns, 1)


def _within(
    ranges: Float[ndarray, "N 2 3"], places: Float[ndarray, "N 3"]
) -> Float[ndarray, "N 3"]:
    return ranges[:, 0] * (1 - places) + ranges[:, 1] * places
