"""Write prepared scenes: photographs as they will be used, cameras and maps in one file."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt16
from numpy import ndarray
from safetensors.numpy import save
from torch import Tensor

from asysplat.data.bad_images import BadImages, Policy
from asysplat.data.images import Resampling, resized_intrinsics
from asysplat.data.prepare.disparity import PNG, image_bytes, load_depth_anything, with_disparities
from asysplat.data.readers import find_scenes, read_scene
from asysplat.data.readers.prepared import SUFFIX, StoredTensors
from asysplat.data.sequence import FileSequence, SceneOptions
from asysplat.data.write import MAX_STEP
from asysplat.errors import InputError
from asysplat.files import atomic_write

ARCHIVE = ".zip"
Tensors = dict[str, Shaped[ndarray, "..."]]


@dataclass(frozen=True)
class Encoding:
    """How photographs are resized and stored: as JPEG, or as WebP without loss.

    With the disparities that the network `disparities` estimates, a folder or a name on the Hub.
    """

    resampling: Resampling = "lanczos"
    lossless: bool = False
    disparities: str | None = None

    def __str__(self) -> str:
        kind = f"{self.resampling}, {'lossless' if self.lossless else 'JPEG'}"
        return f"{kind}, disparities of {self.disparities}" if self.disparities else kind

    @property
    def options(self) -> dict[str, Any]:
        """Pillow's options; colors of JPEG are not subsampled."""
        if self.lossless:
            return {"format": "WEBP", "lossless": True}
        return {"format": "JPEG", "quality": 95, "subsampling": 0}


@dataclass(frozen=True)
class Preparation:
    """What is prepared of each scene, and where.

    Args:
        out: its files are out/<height>x<width>/<scene>.safetensors.
        sizes: heights and widths.
        layout: layout of the scenes.
        on_error: whether an image that cannot be used makes its scene a bad one, or is left out.
    """

    out: Path
    sizes: Sequence[tuple[int, int]]
    encoding: Encoding
    layout: str = "auto"
    on_error: Policy = "fail"

    def file(self, scene: Path, size: tuple[int, int]) -> Path:
        """Return the file of a scene, a folder or an archive."""
        name = scene.name.removesuffix(ARCHIVE)
        return self.out / "x".join(map(str, size)) / f"{name}{SUFFIX}"

    def missing(self, scene: Path) -> list[tuple[int, int]]:
        """List the sizes that a scene has no file of; check how the others were stored."""
        missing = []
        for size in self.sizes:
            file = self.file(scene, size)
            if not file.is_file():
                missing.append(size)
            elif (found := StoredTensors(file).metadata["encoding"]) != str(self.encoding):
                raise InputError(
                    f"{file} is stored as {found}, not as {self.encoding}: give those options, or "
                    "another folder."
                )
        return missing


def find_sources(root: Path, layout: str) -> tuple[str, list[Path]]:
    """Return the layout of scenes and the scenes: archives if there are any, each of one scene."""
    # Two levels alone: DL3DV has no deeper ones, and millions of photographs may lie below.
    levels = (f"*{ARCHIVE}", f"*/*{ARCHIVE}")
    found = sorted(file for level in levels for file in root.glob(level))
    archives = [root] if root.suffix == ARCHIVE else found
    return (layout, archives) if archives else find_scenes(root, layout)


def prepare_scene(scene: Path, preparation: Preparation) -> int | str:
    """Write the missing files of a scene; return its number of images, or why there is none.

    Raises:
        InputError: a file that cannot be written.
    """
    encoding, bad = preparation.encoding, BadImages(preparation.on_error)
    sizes = preparation.missing(scene)
    try:
        with unpacked(scene, preparation.layout) as (layout, path):
            posed = read_scene(layout, path, bad)
            if encoding.disparities:
                network = load_depth_anything(encoding.disparities, download=False)
                posed = with_disparities(posed, network, bad)
            options = [SceneOptions(*size, resampling=encoding.resampling) for size in sizes]
            sequences = [FileSequence(posed, option) for option in options]
            encoded: dict[int, list[dict[str, bytes]]] = {}  # by the index of the image
            for index, image in enumerate(posed.images):
                with bad.collect(str(image.file)):
                    encoded[index] = [encode(s, index, encoding) for s in sequences]
            bad.report(str(scene), len(encoded))
            points = posed.read_points() if posed.read_points else None
    except InputError as error:
        return str(error)
    for position, (size, sequence) in enumerate(zip(sizes, sequences, strict=True)):
        file, images = preparation.file(scene, size), [each[position] for each in encoded.values()]
        file.parent.mkdir(parents=True, exist_ok=True)
        tensors = describe(sequence, list(encoded)) | concatenated(images)
        if points is not None:
            tensors["points"] = points
        with atomic_write(file) as partial:
            notes = {"encoding": str(encoding), "hash": content_hash(tensors)}
            partial.write_bytes(save(tensors, notes))  # readable for others, as save_file's is not
    return len(encoded)


def is_whole(file: Path) -> bool:
    """Check whether a file holds what was written."""
    try:
        stored = StoredTensors(file)
        tensors = {name: stored[name] for name in stored.entries}
        return stored.metadata["hash"] == content_hash(tensors)
    except (InputError, ValueError):
        return False


def content_hash(tensors: Tensors) -> str:
    """Hash the bytes of tensors, in the order of their names."""
    digest = blake2b(digest_size=16)
    for name in sorted(tensors):
        digest.update(tensors[name].tobytes())
    return digest.hexdigest()


@contextmanager
def unpacked(scene: Path, layout: str) -> Generator[tuple[str, Path]]:
    """Yield the layout and the folder of a scene; an archive's is removed at the end."""
    if scene.suffix != ARCHIVE:
        yield layout, scene
        return
    with TemporaryDirectory() as folder:
        try:
            with ZipFile(scene) as archive:
                archive.extractall(folder)
        except (BadZipFile, EOFError) as error:
            raise InputError(f"{scene} cannot be unpacked ({error}): copy it again.") from error
        layout, scenes = find_scenes(folder, layout)
        if len(scenes) > 1:
            raise InputError(f"{scene} holds {len(scenes)} scenes: pack each in a file of its own.")
        yield layout, scenes[0]


def describe(sequence: FileSequence, indices: Sequence[int]) -> Tensors:
    """Collect what is known of a sequence's images besides their pixels."""
    scene, size = sequence.scene, (sequence.options.height, sequence.options.width)
    images = [scene.images[index] for index in indices]
    pinholes = [resized_intrinsics(image.lens, *size) for image in images]
    return {
        "lens": np.array([(k[0, 0], k[1, 1], k[0, 2], k[1, 2]) for k in pinholes]),
        "cam_to_world": np.array([image.cam_to_world for image in images], dtype=np.float64),
        "depth_unit": np.array([image.depth_unit for image in images]),
        "held_out": np.array([image.held_out for image in images], dtype=np.uint8),
        "origin": np.array(scene.origin),
    }


def encode(sequence: FileSequence, index: int, encoding: Encoding) -> dict[str, bytes]:
    """Encode an image and its maps, by kind."""
    views, unit = sequence.stored([index]), sequence.scene.images[index].depth_unit
    maps = {"image": views.images.movedim(1, -1)}
    # Masks of an object with a distorting lens are left out: beyond its border nothing is opaque.
    if views.alphas is not None:
        maps["alpha"] = (255 * views.alphas).round().byte()
    elif views.masks is not None:
        maps["mask"] = views.masks
    if views.depths is not None:
        maps["depth"] = steps_of(views.depths.double() / unit)
    if views.disparities is not None:
        maps["disparity"] = steps_of(views.disparities)
    options = {"image": encoding.options}
    return {k: image_bytes(v[0].numpy(), **options.get(k, PNG)) for k, v in maps.items()}


def steps_of(values: Float[Tensor, "..."]) -> UInt16[Tensor, "..."]:
    """Round to 16 bits; what is beyond them is unknown, 0."""
    return values.round().where(values.round() <= MAX_STEP, 0).to(torch.uint16)


def concatenated(images: Sequence[dict[str, bytes]]) -> Tensors:
    """Put the bytes of all images of each kind one after the other."""
    tensors: Tensors = {}
    for kind in images[0]:
        parts = [image[kind] for image in images]
        tensors[kind] = np.frombuffer(b"".join(parts), dtype=np.uint8)
        tensors[f"{kind}_ends"] = np.cumsum([len(part) for part in parts])
    return tensors
