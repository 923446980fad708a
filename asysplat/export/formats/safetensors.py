"""Gaussians as safetensors, with metadata."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from asysplat.errors import InputError
from asysplat.export.formats.packing import prepare_for_export, require_file
from asysplat.files import atomic_write
from asysplat.scene import Gaussians

NAMES = tuple(field.name for field in fields(Gaussians))


def write_safetensors(
    path: str | Path,
    gaussians: Gaussians,
    metadata: dict[str, str] | None = None,
    dtype: torch.dtype = torch.float32,
) -> None:
    """Write one scene's means, quats, scales, opacities and sh, and metadata."""
    gaussians = prepare_for_export(gaussians, dtype)
    content = save({name: getattr(gaussians, name).contiguous() for name in NAMES}, metadata)
    with atomic_write(path) as partial:
        partial.write_bytes(content)


def read_safetensors(
    path: str | Path, dtype: torch.dtype = torch.float32
) -> tuple[Gaussians, dict[str, str]]:
    """Read a scene and its metadata, as written by `write_safetensors`."""
    path = require_file(path)
    with _open(path) as file:
        tensors = {name: file.get_tensor(name).to(dtype) for name in file.keys()}  # noqa: SIM118
        metadata = file.metadata() or {}
    if missing := [name for name in NAMES if name not in tensors]:
        raise InputError(
            f"{path} has no {', '.join(missing)}: expected the fields {', '.join(NAMES)} of a "
            "scene."
        )
    try:
        gaussians = Gaussians(**{name: tensors[name] for name in NAMES})
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if gaussians.opacities.ndim != 1 or gaussians.num_gaussians == 0:
        shape = tuple(gaussians.opacities.shape)
        raise InputError(
            f"{path} has opacities of shape {shape}: expected [N], one Gaussian or more."
        )
    return gaussians.validate(f"{path}: Gaussians"), metadata


def read_metadata(path: str | Path) -> dict[str, str]:
    """Read the metadata of a file alone, without its tensors."""
    with _open(require_file(path)) as file:
        return file.metadata() or {}


@contextmanager
def _open(path: Path) -> Iterator[safe_open]:
    try:
        with safe_open(path, "pt") as file:
            yield file
    except SafetensorError as error:
        raise InputError(
            f"{path} cannot be read as safetensors ({error}): it is cut off or of another format; "
            "copy it again."
        ) from error
