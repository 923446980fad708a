"""Gaussians as SPZ, of Niantic's tools and many viewers: about 20 bytes each, then compressed.

Format: https://github.com/nianticlabs/spz. Its axes are OpenGL's: right, up, backward.
"""

import gzip
import io
import math
import struct
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from numpy import ndarray

from asysplat.errors import InputError
from asysplat.export.formats import packing
from asysplat.files import atomic_write
from asysplat.scene import Gaussians

MAGIC = b"NGSP"
# Magic, version, count, SH degree, fraction bits, flags, streams.
HEADER = struct.Struct("<4sIIBBBB")
TABLE = struct.Struct("<QQ")  # of a stream in version 4: compressed and full size
HEADER_4 = 32  # bytes of the header in version 4
ANTIALIASED = 1  # a flag
SH_SIZES = (0, 9, 24, 45, 72)  # numbers per Gaussian, by degree; of degree 4, 45 are read
MAX_FRACTION_BITS = 23  # of a position's 24, one of which is the sign
SMALL_QUANTILE, STEPS_PER_SIZE = 0.01, 16  # Gaussians' size that sets the precision of positions
COLOR_FACTOR = 0.15  # a byte of color is 255 (0.5 + 0.15 sh)
SH_BITS = 6  # the format's own writer keeps 5 of degree 1 and 4 of the others, which costs .8 dB
GZIP_LEVEL, ZSTANDARD_LEVEL = 6, 12  # higher ones save 2 to 5 % in 5 times the time


class Header(NamedTuple):
    """What a file says of its Gaussians."""

    version: int
    count: int
    degree: int
    fraction_bits: int
    antialiased: bool

    def sizes(self) -> list[int]:
        """Return the bytes of positions, alphas, colors, scales, rotations and SH."""
        rotation = 3 if self.version == 2 else 4
        return [self.count * size for size in (9, 1, 3, 3, rotation, SH_SIZES[self.degree])]


def write_spz(
    path: str | Path, gaussians: Gaussians, version: int = 3, antialiased: bool = False
) -> None:
    """Write one scene, without batch dimension, as SPZ.

    Positions are rounded to a 16th of the small Gaussians' size if 24 bits allow, scales to 3 %,
    opacities to 1/255, SH to 6 bits of [-1, 1], rotations to 0.1 degrees.
    Gaussians are ordered along a Z-order curve. A flag tells whether they are to be rendered
    `antialiased`. Most programs read version 2 or 3, gzip; 4, Zstandard, needs a package for it.
    """
    content = encode_spz(gaussians, version, antialiased)
    with atomic_write(path) as partial:
        partial.write_bytes(content)


def encode_spz(gaussians: Gaussians, version: int = 3, antialiased: bool = False) -> bytes:
    """Return the content of an SPZ file; see `write_spz`."""
    if version not in (2, 3, 4):
        raise InputError(f"write_spz's version is {version!r}: choose 2, 3 or 4.")
    scene = packing.in_morton_order(packing.half_turn(packing.prepare_for_export(gaussians), 0))
    degree, bits = math.isqrt(scene.sh.shape[1]) - 1, _fraction_bits(scene)
    streams = [stream.tobytes() for stream in _streams(scene, bits, version)]
    header = (MAGIC, version, scene.num_gaussians, degree, bits, ANTIALIASED * antialiased)
    if version < 4:
        return gzip.compress(b"".join([HEADER.pack(*header, 0), *streams]), GZIP_LEVEL, mtime=0)
    streams = [stream for stream in streams if stream]
    compress = _zstandard().ZstdCompressor(ZSTANDARD_LEVEL).compress
    packed = [compress(stream) for stream in streams]
    start = HEADER.pack(*header, len(packed)) + struct.pack("<I12x", HEADER_4)
    sizes = [TABLE.pack(len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    return b"".join([start, *sizes, *packed])


def _fraction_bits(scene: Gaussians) -> int:
    """Choose the precision of positions: finer than small Gaussians, the bits would be noise."""
    largest, size = scene.means.abs().max().item(), scene.scales.amax(1)
    small = size.kthvalue(1 + int(SMALL_QUANTILE * (len(size) - 1))).values.item()
    wanted = math.ceil(math.log2(STEPS_PER_SIZE / small))
    possible = MAX_FRACTION_BITS - math.ceil(math.log2(max(largest, 2.0**-MAX_FRACTION_BITS)))
    if possible < 0:
        raise InputError(
            f"Gaussians.means reach {largest:g}: SPZ holds numbers up to {2**MAX_FRACTION_BITS}; "
            "scale the scene, or write another format."
        )
    return min(max(wanted, 0), possible, MAX_FRACTION_BITS)


def _streams(scene: Gaussians, fraction_bits: int, version: int) -> Iterator[UInt8[ndarray, "..."]]:
    """Return positions, alphas, colors, scales, rotations and SH as bytes."""
    limit = 2**MAX_FRACTION_BITS - 1
    fixed = (scene.means.double() * 2.0**fraction_bits).round().clamp(-limit, limit)
    fixed = fixed.to(torch.int32).numpy()
    yield fixed.astype("<i4")[..., None].view(np.uint8)[..., :3]
    yield _byte(255 * scene.opacities.double())
    yield _byte(255 * (COLOR_FACTOR * scene.sh[:, 0].double() + 0.5))
    yield _byte(16 * (scene.scales.double().log() + 10))
    quats = scene.quats.roll(-1, 1)  # xyzw
    if version == 2:
        quats = torch.nn.functional.normalize(quats.double(), dim=-1)
        quats = torch.where(quats[:, 3:] < 0, -quats, quats)
        yield _byte(127.5 * (quats[:, :3] + 1))
    else:
        index, rest = (part.numpy() for part in packing.split_largest(quats))
        sizes = (511 * np.sqrt(2) * np.abs(rest) + 0.5).astype(np.uint32)
        ten_bits = sizes | (rest < 0).astype(np.uint32) << 9
        packed = index.astype(np.uint32)
        for column in ten_bits.T:
            packed = packed << 10 | column
        yield packed.astype("<u4")[:, None].view(np.uint8)
    sh = 128 * scene.sh[:, 1:].double().numpy() + 128
    step = 2.0 ** (8 - SH_BITS)
    yield (step * np.floor(sh / step + 0.5)).clip(0, 255).astype(np.uint8)


def read_spz(path: str | Path) -> Gaussians:
    """Read one scene from SPZ, version 2, 3 or 4; SH of degree 4 are left out."""
    with packing.reading(path, "SPZ") as path:
        header, streams = _read_streams(path.read_bytes())
        count = header.count
        positions, alphas, colors, scales, rotations, sh = (
            np.frombuffer(stream, np.uint8).reshape(count, size // count)
            for stream, size in zip(streams, header.sizes(), strict=True)
        )
        fixed = np.zeros((count, 3, 4), np.uint8)
        fixed[..., 1:] = positions.reshape(-1, 3, 3)  # the sign stands in the highest byte
        means = (fixed.view("<i4")[..., 0] >> 8) * 2.0**-header.fraction_bits
        rest_count = min(header.degree + 1, 4) ** 2 - 1
        rest = (sh.reshape(count, -1, 3)[:, :rest_count].astype(np.float32) - 128) / 128
        color = (colors[:, None] / np.float32(255) - 0.5) / COLOR_FACTOR
        gaussians = Gaussians(
            means=torch.from_numpy(means).float(),
            quats=_quats(rotations).roll(1, 1).float(),
            scales=torch.from_numpy(np.exp(scales / np.float32(16) - 10)),
            opacities=torch.from_numpy(alphas[:, 0] / np.float32(255)).clamp_min(packing.TINY),
            sh=torch.from_numpy(np.concatenate((color, rest), 1)),
        )
        return packing.half_turn(gaussians, 0).validate()


def is_antialiased(path: Path) -> bool:
    """Read whether a file is to be rendered with `antialiased`."""
    with packing.reading(path, "SPZ") as path, open(path, "rb") as file:
        start = file.read(HEADER.size)
        if not start.startswith(MAGIC):
            file.seek(0)
            start = gzip.GzipFile(fileobj=file).read(HEADER.size)
        return _header(start).antialiased


def _read_streams(content: bytes) -> tuple[Header, list[bytes]]:
    """Unpack the header, and the bytes of positions, alphas, colors, scales, rotations and SH."""
    if not content.startswith(MAGIC):  # versions 2 and 3: all in one gzip stream
        unpacked = io.BytesIO(gzip.decompress(content))
        header = _header(unpacked.read(HEADER.size))
        return header, [unpacked.read(size) for size in header.sizes()]
    header, streams = _header(content), []
    (table,) = struct.unpack_from("<I", content, HEADER.size)
    stored = [size for size in header.sizes() if size]
    start = table + TABLE.size * len(stored)
    for index, size in enumerate(stored):
        packed, _ = TABLE.unpack_from(content, table + TABLE.size * index)
        decompressor = _zstandard().ZstdDecompressor()
        streams.append(decompressor.decompress(content[start : start + packed], size))
        start += packed
    return header, streams + [b""] * (len(header.sizes()) - len(stored))


def _quats(rotations: UInt8[ndarray, "N size"]) -> torch.Tensor:
    """Unpack rotations of 3 or 4 bytes to quaternions, xyzw."""
    if rotations.shape[1] == 3:
        xyz = rotations / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(1, keepdims=True)))
        return torch.nn.functional.normalize(torch.from_numpy(np.concatenate((xyz, w), 1)), dim=-1)
    packed = np.ascontiguousarray(rotations).view("<u4")
    ten_bits = packed >> np.array([20, 10, 0], np.uint32) & 1023
    rest = (ten_bits & 511) / (511 * np.sqrt(2)) * np.where(ten_bits >> 9, -1, 1)
    return packing.join_largest((packed[:, 0] >> 30).astype(np.int64), rest)


def _header(content: bytes) -> Header:
    magic, *numbers, flags, _ = HEADER.unpack_from(content)
    header = Header(*numbers, bool(flags & ANTIALIASED))
    if magic != MAGIC or header.version not in (2, 3, 4) or not header.count:
        raise InputError(
            f"{magic!r} of version {header.version} with {header.count} Gaussians: expected "
            f"{MAGIC!r}, version 2 to 4, and one or more."
        )
    return header


def _zstandard() -> ModuleType:
    try:
        return import_module("zstandard")
    except ImportError as error:
        raise InputError(
            "SPZ of version 4 needs zstandard: pip install 'asysplat[spz]'."
        ) from error


def _byte(values: torch.Tensor) -> UInt8[ndarray, "..."]:
    return values.round().clamp(0, 255).to(torch.uint8).numpy()
