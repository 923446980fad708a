"""Read and write Gaussians in the format that a file's suffix names."""

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
        InputError: another suffix, or what the format's reader refuses.
    """
    return _of_suffix(READERS, path, "read")(path)


def write_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write one scene, without batch dimension, to a .ply or .safetensors file.

    A file that is there already is replaced once the new one is whole.

    Raises:
        InputError: another suffix, or what the format's writer refuses.
    """
    _of_suffix(WRITERS, path, "written")(path, gaussians)


def _of_suffix(functions: dict[str, Callable], path: str | Path, done: str) -> Callable:
    suffix = Path(path).suffix.lower()
    if suffix not in functions:
        raise InputError(
            f"{path} cannot be {done}: its suffix is {suffix or 'missing'}, expected "
            f"{' or '.join(functions)}."
        )
    return functions[suffix]
