"""Read and write Gaussians in the format of the file's suffix, and the cameras beside it."""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from asysplat.data.readers.transforms import read_cameras, read_poses
from asysplat.errors import InputError
from asysplat.export.formats import sog, spz
from asysplat.export.formats.compressed_ply import write_compressed_ply
from asysplat.export.formats.glb import read_glb, write_glb
from asysplat.export.formats.ply import read_comment, read_ply, write_ply
from asysplat.export.formats.safetensors import read_metadata, read_safetensors, write_safetensors
from asysplat.export.formats.sog import read_sog, write_sog
from asysplat.export.formats.splat import read_splat, write_splat
from asysplat.export.formats.spz import read_spz, write_spz
from asysplat.export.page import BLACK, PAGE, write_page
from asysplat.scene import Cameras, Gaussians


class Notes(NamedTuple):
    """What a file says besides its Gaussians.

    Args:
        offset: to be added to the means, for the coordinates of the photographs.
        background: RGB in [0, 1] behind the Gaussians; empty: unknown.
        antialiased: whether they are to be rendered so, see `render`.
    """

    offset: Sequence[float] = (0.0, 0.0, 0.0)
    background: Sequence[float] = ()
    antialiased: bool = False

    @property
    def look(self) -> dict[str, Any]:
        """The options of pages and viewers."""
        return {"background": self.background or BLACK, "antialiased": self.antialiased}


NO_NOTES = Notes()
READERS = {
    ".ply": lambda path, dtype: read_ply(path).to(dtype),
    ".spz": lambda path, dtype: read_spz(path).to(dtype),
    ".sog": lambda path, dtype: read_sog(path).to(dtype),
    ".glb": lambda path, dtype: read_glb(path).to(dtype),
    ".splat": lambda path, dtype: read_splat(path).to(dtype),
    ".safetensors": lambda path, dtype: read_safetensors(path, dtype)[0],
}
# Of the notes, a file has what its format has a place for.
WRITERS = {
    ".compressed.ply": lambda path, scene, notes: write_compressed_ply(
        path, scene, notes.antialiased
    ),
    ".ply": lambda path, scene, notes: write_ply(path, scene, *notes),
    ".spz": lambda path, scene, notes: write_spz(path, scene, antialiased=notes.antialiased),
    ".sog": lambda path, scene, notes: write_sog(path, scene, notes.antialiased),
    ".glb": lambda path, scene, _: write_glb(path, scene),
    ".splat": lambda path, scene, _: write_splat(path, scene),
    ".safetensors": lambda path, scene, notes: write_safetensors(path, scene, _metadata(notes)),
    PAGE: lambda path, scene, notes: write_page(path, scene, camera_before(scene), **notes.look),
}


def read_gaussians(
    path: str | Path, origin: Sequence[float] | None = None, dtype: torch.dtype = torch.float32
) -> Gaussians:
    """Read a scene from a .ply, .spz, .sog, .glb, .splat or .safetensors file.

    Args:
        path: the file.
        origin: origin of the means' coordinates; None: the file's own, whose offset (see
            `write_ply`) is left out.
        dtype: the result's type; only .safetensors may hold more than float32.

    Raises:
        InputError: another suffix, or see the format's reader.

    Example:
        >>> from asysplat import read_gaussians
        >>> gaussians = read_gaussians("scene.ply")
        >>> gaussians.means.shape
        torch.Size([1000, 3])
    """
    gaussians = READERS[suffix_of(path, READERS, "read")](path, dtype)
    if origin is None:
        return gaussians
    offset = torch.tensor(read_notes(Path(path)).offset, dtype=torch.float64)
    shift = offset - torch.tensor(origin, dtype=torch.float64)
    moved = replace(gaussians, means=(gaussians.means.double() + shift).to(dtype))
    return moved.validate(f"{path}, moved by its offset: Gaussians")


def read_notes(path: Path) -> Notes:
    """Read what a file says besides its Gaussians."""
    texts, antialiased = {}, False
    match path.suffix.lower():
        case ".ply":
            texts = {name: read_comment(path, name) for name in Notes._fields}
        case ".safetensors":
            texts = read_metadata(path)
        case ".spz":
            antialiased = spz.is_antialiased(path)
        case ".sog":
            antialiased = sog.is_antialiased(path)
    return Notes(
        offset=_numbers(texts.get("offset", "")) or NO_NOTES.offset,
        background=_numbers(texts.get("background", "")),
        antialiased=antialiased or texts.get("antialiased", "").strip() == "1",
    )


def _numbers(text: str) -> tuple[float, ...]:
    """Read three finite numbers; none where a text has others."""
    try:
        numbers = tuple(map(float, text.split()))
    except ValueError:
        return ()
    return numbers if len(numbers) == 3 and all(map(math.isfinite, numbers)) else ()


def write_gaussians(path: str | Path, gaussians: Gaussians, notes: Notes = NO_NOTES) -> None:
    """Write one scene, without batch dimension, in the format of the file's suffix.

    An existing file is replaced once the new one is complete.

    Args:
        path: a .ply, .compressed.ply, .spz, .sog, .glb, .splat, .safetensors or .html file; see
            `write_page` for a page with cameras.
        gaussians: [N].
        notes: what else the file says, as far as its format has a place for it.

    Raises:
        InputError: another suffix, or see the format's writer.

    Example:
        >>> from asysplat import read_gaussians, write_gaussians
        >>> write_gaussians("scene.spz", read_gaussians("scene.ply"))
    """
    WRITERS[suffix_of(path, WRITERS, "written")](path, gaussians, notes)


def _metadata(notes: Notes) -> dict[str, str]:
    numbers = {"offset": notes.offset if any(notes.offset) else (), "background": notes.background}
    numbers["antialiased"] = (1,) if notes.antialiased else ()
    return {name: " ".join(map(repr, values)) for name, values in numbers.items() if values}


def suffix_of(path: str | Path, suffixes: Collection[str], verb: str) -> str:
    """Return which of the suffixes a file has; `verb` says what for, in the message."""
    name = Path(path).name.lower()
    for suffix in suffixes:
        if name.endswith(suffix):
            return suffix
    found = Path(path).suffix or "missing"
    *others, last = suffixes
    raise InputError(
        f"{path} cannot be {verb}: its suffix is {found}, expected {', '.join(others)} or {last}."
    )


CAMERAS = "transforms.json"  # beside a file of Gaussians
MIN_IN_VIEW = 0.5  # fraction of the Gaussians that its cameras see, if they are the scene's


def cameras_beside(scene: Path, gaussians: Gaussians) -> Cameras | None:
    """Read the cameras beside a file of Gaussians; None, and a line why, where none fit it."""
    file = scene.with_name(CAMERAS)
    if not file.exists():
        return None
    try:
        cameras = read_cameras(file)
    except (InputError, OSError) as error:
        print(f"without cameras: {error}")
        return None
    seen = torch.zeros(gaussians.num_gaussians, dtype=torch.bool)
    for view in range(cameras.num_views):
        seen |= cameras.select([view]).project(gaussians.means)[2][0]
    if (visible := seen.float().mean().item()) < MIN_IN_VIEW:
        print(f"without cameras: those of {file} have {visible:.0%} of the Gaussians in view.")
        return None
    return cameras


def names_beside(scene: Path) -> list[str]:
    """Return the photographs' names of the cameras beside a file of Gaussians."""
    return [Path(name).name for name, _ in read_poses(scene.with_name(CAMERAS))]


def camera_before(gaussians: Gaussians) -> Cameras:
    """Make a camera that has most Gaussians in view, with y down as COLMAP's worlds often have."""
    center = gaussians.means.median(0).values
    radius = (gaussians.means - center).norm(dim=-1).median()
    pose = torch.eye(4)
    pose[:3, 3] = center - torch.tensor([0.0, 0.0, 3.0]) * radius
    intrinsics = torch.tensor([[256, 0, 128], [0, 256, 128], [0, 0, 1.0]])
    return Cameras(intrinsics[None], pose[None], 256, 256)
