"""Gaussians as binary glTF with the extension KHR_gaussian_splatting, in float32.

Format: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting.
glTF's axes are left, up, forward.
"""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from asysplat.errors import InputError
from asysplat.export.formats.packing import TINY, half_turn, prepare_for_export, reading
from asysplat.files import atomic_write
from asysplat.geometry.motion import rotations, transform
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.scene import Gaussians

MAGIC, VERSION = b"glTF", 2
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
JSON, BINARY = b"JSON", b"BIN\0"  # kinds of chunks
EXTENSION = "KHR_gaussian_splatting"
KERNEL = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))
POINTS, ARRAY_BUFFER = 0, 34962  # glTF's numbers for a mode and a target
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}  # of components
COMPONENTS = {
    "float32": {"componentType": 5126},
    "uint8": {"componentType": 5121, "normalized": True},
}
SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}  # numbers of components by the kind of accessor
KINDS = {size: kind for kind, size in SIZES.items()}
TOLERANCE = 1e-4  # of rotations that others wrote in float32


def write_glb(path: str | Path, gaussians: Gaussians) -> None:
    """Write one scene, without batch dimension; programs that lack the extension show points.

    Quaternions are normalized; all else keeps its bits.
    """
    scene = half_turn(prepare_for_export(gaussians), 2)
    quats = torch.nn.functional.normalize(scene.quats.double(), dim=-1).float().roll(-1, 1)
    diffuse = (0.5 + SH_C0 * scene.sh[:, 0]).clamp(0, 1)
    colors = torch.cat((to_linear(diffuse), scene.opacities[:, None]), 1)
    colors = (255 * colors).round().byte()
    attributes = {"POSITION": scene.means, "COLOR_0": colors, ROTATION: quats, SCALE: scene.scales}
    attributes[OPACITY] = scene.opacities[:, None]
    attributes |= dict(zip(_sh_names(scene.sh.shape[1]), scene.sh.unbind(1), strict=True))
    arrays = [tensor.numpy() for tensor in attributes.values()]
    views, accessors, size = [], [], 0
    for index, array in enumerate(arrays):
        accessor = {"bufferView": index, "count": len(array), "type": KINDS[array.shape[1]]}
        accessors.append(accessor | COMPONENTS[array.dtype.name])
        view = {"buffer": 0, "byteOffset": size, "byteLength": array.nbytes}
        views.append(view | {"target": ARRAY_BUFFER})
        size += array.nbytes
    accessors[0] |= {"min": scene.means.amin(0).tolist(), "max": scene.means.amax(0).tolist()}
    places = {name: index for index, name in enumerate(attributes)}
    primitive = {"attributes": places, "mode": POINTS, "extensions": {EXTENSION: KERNEL}}
    document = {"asset": {"version": "2.0", "generator": "asysplat"}, "extensionsUsed": [EXTENSION]}
    document |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    document |= {"meshes": [{"primitives": [primitive]}], "accessors": accessors}
    document |= {"bufferViews": views, "buffers": [{"byteLength": size}]}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = HEADER.size + CHUNK.size + len(text) + CHUNK.size + size
    if total >= 2**32:
        raise InputError(
            f"Gaussians.opacities has {len(colors):,} Gaussians, {total} bytes: glTF holds up to "
            f"{2**32 - 1}; write parts, or another format."
        )
    with atomic_write(path) as partial, open(partial, "wb") as file:
        file.write(HEADER.pack(MAGIC, VERSION, total))
        file.write(CHUNK.pack(len(text), JSON) + text)
        file.write(CHUNK.pack(size, BINARY))
        for array in arrays:
            file.write(np.ascontiguousarray(array).data)


def to_linear(colors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Convert sRGB in [0, 1] to linear light, as glTF's colors of vertices are."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def _sh_names(count: int) -> list[str]:
    places = [(math.isqrt(index), index - math.isqrt(index) ** 2) for index in range(count)]
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}" for degree, order in places]


def read_glb(path: str | Path) -> Gaussians:
    """Read the Gaussians of a binary glTF file, which may hold other meshes, too.

    Nodes may move, turn and scale them, by the same factor along all axes.
    """
    with reading(path, "binary glTF") as path:
        root, buffer = _read_chunks(path.read_bytes())
        if others := {*root.get("extensionsRequired", ())} - {EXTENSION}:
            raise InputError(f"it needs the extension {min(others)}: write it without compression.")
        primitive, motion = _find(root)
        splats = primitive["extensions"][EXTENSION]
        known = all(splats.get(key, value) == value for key, value in KERNEL.items())
        if primitive.get("mode") != POINTS or not known or splats.get("extensions"):
            raise InputError(
                f"its Gaussians are {splats}: expected uncompressed points of {KERNEL}."
            )
        attributes = primitive["attributes"]
        degree = max(d for d in range(4) if d == 0 or _sh_names(16)[d * d] in attributes)
        names = ["POSITION", ROTATION, SCALE, OPACITY, *_sh_names((degree + 1) ** 2)]
        columns = [torch.from_numpy(_read_accessor(root, buffer, attributes[n])) for n in names]
        means, quats, scales, opacities, *sh = columns
        if not (quats != 0).any(1).all():
            raise InputError("a rotation is 0: repair or remove that Gaussian.")
        gaussians = Gaussians(
            means=means,
            quats=torch.nn.functional.normalize(quats.double(), dim=-1).float().roll(1, 1),
            scales=torch.where(scales == 0, TINY, scales),
            opacities=torch.where(opacities == 0, TINY, opacities)[:, 0],
            sh=torch.stack(sh, 1),
        )
        return half_turn(_move(gaussians, motion), 2).validate()


def _read_chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Read the JSON of a file and the bytes of its buffer."""
    magic, version, total = HEADER.unpack_from(content)
    if magic != MAGIC or version != VERSION or total > len(content):
        raise InputError(
            f"{magic!r}, version {version}, {len(content)} of {total} bytes: expected binary glTF "
            f"of version {VERSION}."
        )
    chunks, start = {}, HEADER.size
    while start < total:
        size, kind = CHUNK.unpack_from(content, start)
        start += CHUNK.size
        chunks.setdefault(kind, content[start : start + size])
        start += size
    return json.loads(chunks[JSON]), chunks[BINARY]


def _find(root: dict[str, Any]) -> tuple[dict[str, Any], Float[Tensor, "4 4"]]:
    """Find the one primitive of Gaussians, and compute its transform to the scene."""
    nodes = root.get("nodes", [])
    parents = {c: index for index, node in enumerate(nodes) for c in node.get("children", ())}
    found = [
        (index, primitive)
        for index, node in enumerate(nodes)
        if "mesh" in node
        for primitive in root["meshes"][node["mesh"]]["primitives"]
        if EXTENSION in primitive.get("extensions", ())
    ]
    if len(found) != 1:
        raise InputError(
            f"{len(found)} primitives with {EXTENSION} in its nodes: expected one; join them in "
            "the program that wrote it."
        )
    ((index, primitive),) = found
    motion = _local_transform(nodes[index])
    while index in parents:
        index = parents[index]
        motion = _local_transform(nodes[index]) @ motion
    return primitive, motion


def _local_transform(node: dict[str, Any]) -> Float[Tensor, "4 4"]:
    matrix = torch.eye(4, dtype=torch.float64)
    if "matrix" in node:
        return matrix.new_tensor(node["matrix"]).view(4, 4).mT
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    scale = matrix.new_tensor(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, :3] = rotations(matrix.new_tensor([w, x, y, z])) * scale
    matrix[:3, 3] = matrix.new_tensor(node.get("translation", (0.0, 0.0, 0.0)))
    return matrix


def _move(gaussians: Gaussians, motion: Float[Tensor, "4 4"]) -> Gaussians:
    identity = torch.eye(4, dtype=torch.float64)
    if torch.equal(motion, identity):
        return gaussians  # with all bits
    scale = motion[:3, :3].det().clamp_min(0) ** (1 / 3)
    rigid = motion.clone()
    rigid[:3, :3] /= scale
    if not ((rigid[:3, :3] @ rigid[:3, :3].mT - identity[:3, :3]).abs() < TOLERANCE).all():
        raise InputError(
            "its nodes stretch, shear or mirror its Gaussians: expected a rotation, a translation "
            "and one scale; apply the others in the program that wrote it."
        )
    return transform(gaussians.scale_by(scale.item()), rigid)


def _read_accessor(root: dict[str, Any], buffer: bytes, index: int) -> Float[ndarray, "N size"]:
    accessor = root["accessors"][index]
    view = root["bufferViews"][accessor["bufferView"]]
    if accessor.get("sparse") or view.get("extensions") or view["buffer"]:
        raise InputError("numbers are sparse, compressed or in another file: write them plainly.")
    dtype = np.dtype(TYPES[accessor["componentType"]])
    shape = (accessor["count"], SIZES[accessor["type"]])
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    strides = (view.get("byteStride", dtype.itemsize * shape[1]), dtype.itemsize)
    values = np.ndarray(shape, dtype, buffer, start, strides).astype(np.float32)
    if accessor.get("normalized") and dtype.kind != "f":
        values = np.maximum(values / np.float32(np.iinfo(dtype).max), -1)
    return values
