"""Read and write Gaussians in the format of the file's suffix."""

from collections.abc import Callable
from pathlib import Path

from asysplat.errors import InputError
from asysplat.export.ply import read_ply, write_ply
from asysplat.export.splat import read_splat
from asysplat.export.tensors import read_safetensors, write_safetensors
from asysplat.scene import Gaussians

READERS = {
    ".ply": read_ply,
    ".splat": read_splat,
    ".safetensors": lambda path: read_safetensors(path)[0],
}
WRITERS = {".ply": write_ply, ".safetensors": write_safetensors}


def read_gaussians(path: str | Path) -> Gaussians:
    """Read a scene from a .ply, .splat or .safetensors file, in float32.

    Raises:
        InputError: another suffix, or see the format's reader.
    """
    return _by_suffix(READERS, path, "read")(path)


def write_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write one scene, without batch dimension, to a .ply or .safetensors file.

    An existing file is replaced once the new one is complete.

    Raises:
        InputError: another suffix, or see the format's writer.
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
