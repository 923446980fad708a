"""Gaussians as SOG, PlayCanvas's: a zip file of lossless WebP images, about 15 bytes a Gaussian.

Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, version 2, in
PLY's axes. Pixel i of each image belongs to Gaussian i.
"""

import json
import math
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image
from threadpoolctl import threadpool_limits
from torch import Tensor

from asysplat.errors import InputError
from asysplat.export.formats import packing
from asysplat.files import atomic_write
from asysplat.scene import Gaussians

VERSION = 2
CODES = 256  # numbers of a codebook
MAX_SIDE = 16380  # pixels of a side of a WebP image, as a multiple of 4
MAX_PALETTE = 65536  # SH that 16 bits distinguish
PALETTE_WIDTH = 64  # SH in a row of their image
PALETTE_SHARE = 4  # Gaussians for each of the palette
MIN_PALETTE = 1024
PALETTE_ITERATIONS = 4
CODEBOOK_ITERATIONS = 50
METHOD, QUALITY = 2, 50  # of WebP: what takes ten times as long saves 0.1 %
FIRST_TAG = 252  # alpha of a rotation whose w is the largest; then x, y, z


def write_sog(path: str | Path, gaussians: Gaussians, antialiased: bool = False) -> None:
    """Write one scene, without batch dimension, as a SOG bundle.

    Means keep 16 bits of sign(x) log(1 + |x|) between the scene's bounds, opacities and three
    components of rotations 8 bits; log scales and colors become the nearest of 256 values that are
    fitted to the scene, the other SH the nearest of a palette. Gaussians are ordered along a
    Z-order curve. meta.json tells whether they are to be rendered `antialiased`.
    """
    scene = packing.in_morton_order(packing.prepare_for_export(gaussians))
    count = len(scene.opacities)
    if count > MAX_SIDE**2:
        raise InputError(
            f"Gaussians.opacities has {count:,} Gaussians: SOG holds up to {MAX_SIDE**2:,}; write "
            "parts, or another format."
        )
    width = 4 * math.ceil(math.sqrt(count) / 4)
    records, images = _quantize(scene)
    files = {name: _webp(pixels, width) for name, pixels in images.items()}
    if scene.sh.shape[1] > 1:
        records["shN"], centroids, labels = _quantize_sh(scene.sh[:, 1:])
        row = PALETTE_WIDTH * (scene.sh.shape[1] - 1)
        files["shN_centroids.webp"] = _webp(centroids, row)
        files["shN_labels.webp"] = _webp(labels, width)
    meta = {"version": VERSION, "count": count, "antialias": antialiased, **records}
    files["meta.json"] = json.dumps(meta, separators=(",", ":")).encode()
    bundle = BytesIO()
    with zipfile.ZipFile(bundle, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # its date is always 1980
    with atomic_write(path) as partial:
        partial.write_bytes(bundle.getvalue())


def _quantize(scene: Gaussians) -> tuple[dict[str, dict], dict[str, Int[Tensor, "N channels"]]]:
    """Compute the records of meta.json and the pixels of the images, of all but shN."""
    logs = scene.means.double().sign() * scene.means.double().abs().log1p()
    low, high = logs.amin(0), logs.amax(0)
    fixed = (65535 * (logs - low) / (high - low).clamp_min(packing.TINY)).round().int()
    largest, rest = packing.split_largest(scene.quats)
    rest = (255 * (0.5 + rest / math.sqrt(2))).round().int()
    scale_codes, scales = _codebook(scene.scales.double().log())
    color_codes, colors = _codebook(scene.sh[:, 0])
    alphas = (255 * scene.opacities).round().int()
    means = {"mins": low.tolist(), "maxs": high.tolist()}
    records = {
        "means": means | {"files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_codes, "files": ["sh0.webp"]},
    }
    images = {
        "means_l.webp": fixed & 255,
        "means_u.webp": fixed >> 8,
        "quats.webp": torch.cat((rest, FIRST_TAG + largest[:, None]), 1),
        "scales.webp": scales,
        "sh0.webp": torch.cat((colors, alphas[:, None]), 1),
    }
    return records, images


def _quantize_sh(
    sh: Float[Tensor, "N terms 3"],
) -> tuple[dict, Int[Tensor, "pixels 3"], Int[Tensor, "N 3"]]:
    """Compute the record of shN, the pixels of the palette and those of its indices."""
    with threadpool_limits(1):  # threads wait for each other longer than small products take
        palette, labels = _palette(sh.flatten(1))
    codes, centroids = _codebook(palette)
    record = {
        "count": len(palette),
        "bands": math.isqrt(sh.shape[1]),
        "codebook": codes,
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    bytes_of_labels = torch.stack((labels & 255, labels >> 8, torch.zeros_like(labels)), 1)
    return record, centroids.reshape(-1, 3), bytes_of_labels


def _webp(pixels: Int[Tensor, "N channels"], width: int) -> bytes:
    """Write pixels as an image, whose last row ends with zeros."""
    height = math.ceil(len(pixels) / width)
    image = np.zeros((height * width, pixels.shape[1]), np.uint8)
    image[: len(pixels)] = pixels.numpy()
    file = BytesIO()
    Image.fromarray(image.reshape(height, width, -1)).save(
        file, "WEBP", lossless=True, exact=True, quality=QUALITY, method=METHOD
    )
    return file.getvalue()


def _codebook(values: Float[Tensor, "*shape"]) -> tuple[list[float], Int[Tensor, "*shape"]]:
    """Fit 256 numbers, ascending, by k-means; return them and the index of each value's nearest."""
    ordered = values.double().flatten().sort().values
    codes = ordered.unique()
    if len(codes) > CODES:
        # Half of them where the values are, half over all of their range.
        share = torch.linspace(0, 1, CODES // 2, dtype=torch.float64)
        quantiles = ordered[(share * (len(ordered) - 1)).round().long()]
        codes = torch.cat((quantiles, ordered[0] + share * (ordered[-1] - ordered[0])))
        codes = codes.sort().values
        sums = torch.cat((torch.zeros(1), ordered.cumsum(0)))
        for _ in range(CODEBOOK_ITERATIONS):
            inner = torch.searchsorted(ordered, _middles(codes))
            bounds = torch.cat((torch.tensor([0]), inner, torch.tensor([len(ordered)])))
            counts = bounds.diff()
            codes = torch.where(counts > 0, sums[bounds].diff() / counts.clamp_min(1), codes)
    codes = torch.cat((codes, codes[-1:].expand(CODES - len(codes))))
    numbers = [float(f"{code:.7g}") for code in codes.tolist()]  # what float32 resolves
    return numbers, torch.searchsorted(_middles(codes), values.double().contiguous())


def _middles(codes: Float[Tensor, "codes"]) -> Float[Tensor, "codes-1"]:
    return (codes[1:] + codes[:-1]) / 2


def _palette(
    values: Float[Tensor, "N terms"],
) -> tuple[Float[Tensor, "colors terms"], Int[Tensor, "N"]]:
    """Fit vectors by k-means, and compute the index of one near to each value.

    In cells of values, as distances to all vectors would take a hundred times as long.
    """
    size = min(max(len(values) // PALETTE_SHARE, MIN_PALETTE), MAX_PALETTE)
    if len(values) <= size:
        return values, torch.arange(len(values))
    generator, cell_count = torch.Generator().manual_seed(0), math.isqrt(size)
    _, cells = _k_means(values, cell_count, generator)
    vectors, labels, total = [], torch.zeros_like(cells), 0
    for cell in range(cell_count):
        (members,) = torch.where(cells == cell)
        if len(members):
            count = 1 + (size - cell_count) * len(members) // len(values)
            part, own = _k_means(values[members], count, generator)
            labels[members] = own + total
            vectors.append(part)
            total += len(part)
    return torch.cat(vectors), labels


def _k_means(
    values: Float[Tensor, "N terms"], count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "{count} terms"], Int[Tensor, "N"]]:
    """Compute centers by Lloyd's iterations from random values, and the nearest of each value."""
    centers = values[torch.randperm(len(values), generator=generator)[:count]]
    for iteration in range(PALETTE_ITERATIONS + 1):
        half_squares = centers.square().sum(1) / 2
        distances = torch.addmm(half_squares, values, centers.mT, alpha=-1)  # but for a constant
        # NumPy's argmin takes a tenth of the time of PyTorch's.
        labels = torch.from_numpy(distances.numpy().argmin(1))
        if iteration == PALETTE_ITERATIONS:
            break
        counts = labels.bincount(minlength=count)[:, None]
        sums = torch.zeros_like(centers).index_add_(0, labels, values)
        centers = torch.where(counts > 0, sums / counts.clamp_min(1), centers)
    return centers, labels


def read_sog(path: str | Path) -> Gaussians:
    """Read one scene from a SOG bundle of version 2."""
    with packing.reading(path, "a SOG bundle") as path, zipfile.ZipFile(path) as archive:
        meta = _read_meta(archive)
        count = meta["count"]
        (low, high) = (torch.tensor(meta["means"][key]).double() for key in ("mins", "maxs"))
        fine, coarse, rotations, scales, colors = (
            image.flatten(0, 1)[:count]
            for name in ("means", "quats", "scales", "sh0")
            for image in _images(archive, meta[name])
        )
        rotations = rotations.numpy()
        largest = rotations[:, 3].astype(np.int64) - FIRST_TAG
        rest = (rotations[:, :3] / 127.5 - 1) / math.sqrt(2)
        fixed = coarse[:, :3].int() << 8 | fine[:, :3]
        logs = low + (high - low) * fixed / 65535
        sh = [_decode(meta["sh0"], colors[:, None, :3])]
        if "shN" in meta:
            sh.append(_read_palette(archive, meta["shN"], count))
        return Gaussians(
            means=(logs.sign() * logs.abs().expm1()).float(),
            quats=packing.join_largest(largest, rest).float(),
            scales=_decode(meta["scales"], scales[:, :3]).exp().clamp_min(packing.TINY),
            opacities=(colors[:, 3] / 255).clamp_min(packing.TINY),
            sh=torch.cat(sh, 1),
        ).validate()


def is_antialiased(path: Path) -> bool:
    """Read whether a file is to be rendered with `antialiased`."""
    with packing.reading(path, "a SOG bundle") as path, zipfile.ZipFile(path) as archive:
        return _read_meta(archive).get("antialias", False)


def _read_meta(archive: zipfile.ZipFile) -> dict[str, Any]:
    meta = json.loads(archive.read("meta.json"))
    if meta["version"] != VERSION:
        raise InputError(f"it has version {meta['version']} of SOG: expected {VERSION}.")
    return meta


def _images(archive: zipfile.ZipFile, record: dict) -> list[UInt8[Tensor, "height width 4"]]:
    files = (BytesIO(archive.read(name)) for name in record["files"])
    images = (Image.open(file, formats=("WEBP",)).convert("RGBA") for file in files)
    return [torch.from_numpy(np.array(image)) for image in images]


def _decode(record: dict, codes: UInt8[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    return torch.tensor(record["codebook"], dtype=torch.float32)[codes.int()]


def _read_palette(archive: zipfile.ZipFile, record: dict, count: int) -> Float[Tensor, "N terms 3"]:
    """Read the SH of degree 1 and above."""
    terms = record["bands"] * (record["bands"] + 2)
    centroids, labels = _images(archive, record)
    low, high = labels.flatten(0, 1)[:count, :2].long().unbind(1)
    return _decode(record, centroids[..., :3].reshape(-1, terms, 3)[low | high << 8])
