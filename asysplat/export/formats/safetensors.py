"""Gaussians as safetensors, with metadata."""

from dataclasses import fields
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save

from asysplat.errors import InputError
from asysplat.export.formats.packing import prepare_for_export, reading
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
    with reading(path, "safetensors") as path, safe_open(path, "pt") as file:
        names = set(file.keys())
        if missing := [name for name in NAMES if name not in names]:
            raise InputError(f"no {', '.join(missing)}: expected the fields {', '.join(NAMES)}.")
        gaussians = Gaussians(*(file.get_tensor(name).to(dtype) for name in NAMES))
        if gaussians.opacities.ndim != 1 or gaussians.num_gaussians == 0:
            shape = tuple(gaussians.opacities.shape)
            raise InputError(f"opacities have shape {shape}: expected [N], one Gaussian or more.")
        return gaussians.validate(), file.metadata() or {}


def read_metadata(path: str | Path) -> dict[str, str]:
    """Read the metadata of a file alone, without its tensors."""
    with reading(path, "safetensors") as path, safe_open(path, "pt") as file:
        return file.metadata() or {}
