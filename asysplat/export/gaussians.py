"""Read and write Gaussians in the format of the file's suffix."""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.export.formats.compressed_ply import SUFFIX, write_compressed_ply
from asysplat.export.formats.glb import read_glb, write_glb
from asysplat.export.formats.ply import read_comment, read_ply, write_ply
from asysplat.export.formats.safetensors import read_safetensors, write_safetensors
from asysplat.export.formats.sog import read_sog, write_sog
from asysplat.export.formats.splat import read_splat, write_splat
from asysplat.export.formats.spz import read_spz, write_spz
from asysplat.export.page import PAGE, write_page
from asysplat.export.scene_cameras import camera_before
from asysplat.scene import Gaussians

BLACK = (0.0, 0.0, 0.0)
MAX_TEXT = 80  # characters of a file in a message
READERS = {
    ".ply": lambda path, dtype: read_ply(path).to(dtype),
    ".spz": lambda path, dtype: read_spz(path).to(dtype),
    ".sog": lambda path, dtype: read_sog(path).to(dtype),
    ".glb": lambda path, dtype: read_glb(path).to(dtype),
    ".splat": lambda path, dtype: read_splat(path).to(dtype),
    ".safetensors": lambda path, dtype: read_safetensors(path, dtype)[0],
}
# The other formats have no place for an offset and a background.
WRITERS = {
    SUFFIX: lambda path, gaussians, *_: write_compressed_ply(path, gaussians),
    ".ply": write_ply,
    ".spz": lambda path, gaussians, *_: write_spz(path, gaussians),
    ".sog": lambda path, gaussians, *_: write_sog(path, gaussians),
    ".glb": lambda path, gaussians, *_: write_glb(path, gaussians),
    ".splat": lambda path, gaussians, *_: write_splat(path, gaussians),
    ".safetensors": lambda path, gaussians, *numbers: write_safetensors(
        path, gaussians, _metadata(*numbers)
    ),
    PAGE: lambda path, gaussians, _, background: write_page(
        path, gaussians, camera_before(gaussians), background=background or BLACK
    ),
}


def read_gaussians(
    path: str | Path,
    origin: Sequence[float] | None = None,
    dtype: torch.dtype = torch.float32,
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
    offset = torch.tensor(read_offset(Path(path)), dtype=torch.float64)
    shift = offset - torch.tensor(origin, dtype=torch.float64)
    return replace(gaussians, means=(gaussians.means.double() + shift).to(dtype))


def read_offset(path: Path) -> list[float]:
    """Read what is to be added to the means of a file for the coordinates of its photographs.

    Raises:
        InputError: numbers that are not finite.
    """
    return _numbers(path, "offset") or [0.0, 0.0, 0.0]


def read_background(path: Path) -> Float[Tensor, "3"] | None:
    """Read the RGB that was behind a file's Gaussians when they were made; None if unknown.

    Raises:
        InputError: numbers that are not finite.
    """
    color = _numbers(path, "background")
    return None if color is None else torch.tensor(color)


def _numbers(path: Path, name: str) -> list[float] | None:
    """Read three numbers from a file's comments or metadata; None where it has none."""
    text = ""
    if path.suffix.lower() == ".ply":
        text = read_comment(path, name)
    elif path.suffix.lower() == ".safetensors":
        text = read_safetensors(path)[1].get(name, "")
    try:
        x, y, z = map(float, text.split())
    except ValueError:
        return None
    if not all(map(math.isfinite, (x, y, z))):
        raise InputError(
            f"{path} has the {name} {text.strip()[:MAX_TEXT]}: give three finite numbers, or "
            "remove it."
        )
    return [x, y, z]


def write_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    offset: Sequence[float] = (0.0, 0.0, 0.0),
    background: Sequence[float] = (),
) -> None:
    """Write one scene, without batch dimension, in the format of the file's suffix.

    An existing file is replaced once the new one is complete.

    Args:
        path: a .ply, .compressed.ply, .spz, .sog, .glb, .splat, .safetensors or .html file; see
            `write_page` for a page with cameras.
        gaussians: [N].
        offset: to be added to the means; kept by .ply and .safetensors.
        background: RGB in [0, 1] behind the Gaussians, if known; kept likewise.

    Raises:
        InputError: another suffix, or see the format's writer.

    Example:
        >>> from asysplat import read_gaussians, write_gaussians
        >>> write_gaussians("scene.spz", read_gaussians("scene.ply"))
    """
    WRITERS[suffix_of(path, WRITERS, "written")](path, gaussians, offset, background)


def _metadata(offset: Sequence[float], background: Sequence[float]) -> dict[str, str]:
    """Write an offset that is not 0, and a background that is known, as metadata."""
    numbers = {"offset": offset if any(offset) else (), "background": background}
    return {name: " ".join(map(repr, values)) for name, values in numbers.items() if values}


def suffix_of(path: str | Path, suffixes: Collection[str], verb: str) -> str:
    """Return which of the suffixes a file has; `verb` says what for, in the message.

    Raises:
        InputError: none of them.
    """
    name = Path(path).name.lower()
    for suffix in suffixes:
        if name.endswith(suffix):
            return suffix
    found = Path(path).suffix or "missing"
    *others, last = suffixes
    raise InputError(
        f"{path} cannot be {verb}: its suffix is {found}, expected {', '.join(others)} or {last}."
    )
