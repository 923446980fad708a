"""Read and write Gaussians in the format of the file's suffix."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.export.formats.ply import read_comment, read_ply, write_ply
from asysplat.export.formats.safetensors import read_safetensors, write_safetensors
from asysplat.export.formats.splat import read_splat
from asysplat.scene import Gaussians

MAX_TEXT = 80  # characters of a file in a message
READERS = {
    ".ply": lambda path, dtype: read_ply(path).to(dtype),
    ".splat": lambda path, dtype: read_splat(path).to(dtype),
    ".safetensors": lambda path, dtype: read_safetensors(path, dtype)[0],
}
WRITERS = {".ply": write_ply, ".safetensors": write_safetensors}


def read_gaussians(
    path: str | Path,
    origin: Sequence[float] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Gaussians:
    """Read a scene from a .ply, .splat or .safetensors file.

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
    gaussians = _by_suffix(READERS, path, "read")(path, dtype)
    if origin is None:
        return gaussians
    offset = _numbers(Path(path), "offset") or (0.0, 0.0, 0.0)
    shift = torch.tensor(offset, dtype=torch.float64) - torch.tensor(origin, dtype=torch.float64)
    return replace(gaussians, means=(gaussians.means.double() + shift).to(dtype))


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


def write_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write one scene, without batch dimension, to a .ply or .safetensors file.

    An existing file is replaced once the new one is complete.

    Raises:
        InputError: another suffix, or see the format's writer.

    Example:
        >>> from asysplat import read_gaussians, write_gaussians
        >>> write_gaussians("scene.safetensors", read_gaussians("scene.ply"))
    """
    _by_suffix(WRITERS, path, "written")(path, gaussians)


def _by_suffix(functions: dict[str, Callable], path: str | Path, verb: str) -> Callable:
    suffix = Path(path).suffix.lower()
    if suffix not in functions:
        raise InputError(
            f"{path} cannot be {verb}: its suffix is {suffix or 'missing'}, expected "
            f"{' or '.join(functions)}."
        )
    return functions[suffix]
