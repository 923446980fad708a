"""The renderers that can run on this machine, behind one call."""

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial

import torch
from torch import Tensor

from asysplat.rendering import GSPLAT_1_5, INRIA, Convention, Skips, render
from asysplat.scene import Cameras, Gaussians

SKIPS = tuple(field.name for field in fields(Skips))
SKIPS_OF_CUDA = tuple(name for name in SKIPS if name != "rows")
Draw = Callable[[Gaussians, Cameras, Skips], tuple[Tensor, dict[str, int]]]


@dataclass(frozen=True)
class Backend:
    """
    Args:
        name: as the tables have it.
        device: where its tensors are.
        draw: image [V, 3, H, W] without background, and counts of what was done.
        skips: names of those that it can switch off.
        convention: its cut-offs.
    """

    name: str
    device: str
    draw: Draw
    skips: tuple[str, ...] = ()
    convention: Convention = INRIA


def find_backends() -> list[Backend]:
    """The reference, which always stands in the table, then the fast ones that can run here."""
    found = [Backend("reference", "cpu", partial(_ours, "reference"))]
    found.append(Backend("cpu", "cpu", partial(_ours, "cpu"), SKIPS))
    if torch.cuda.is_available():
        found.append(Backend("cuda", "cuda", partial(_ours, "cuda"), SKIPS_OF_CUDA))
        if importlib.util.find_spec("gsplat"):
            found.append(Backend("gsplat", "cuda", _gsplat, convention=GSPLAT_1_5))
    return found


def _ours(
    backend: str, gaussians: Gaussians, cameras: Cameras, skips: Skips
) -> tuple[Tensor, dict[str, int]]:
    out = render(gaussians, cameras, backend=backend, depth=False, skips=skips)
    return out.image, out.stats


def _gsplat(gaussians: Gaussians, cameras: Cameras, skips: Skips) -> tuple[Tensor, dict[str, int]]:
    """gsplat 1.5 in its faster form, which is not the packed one; it has no skips to switch."""
    from gsplat import rasterization

    images, _, meta = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        torch.linalg.inv(cameras.cam_to_world),
        cameras.intrinsics,
        cameras.width,
        cameras.height,
        sh_degree=math.isqrt(gaussians.sh.shape[-2]) - 1,
        packed=False,
    )
    stats = {"pairs": len(meta["flatten_ids"]), "tile_size": meta["tile_size"]}
    return images.movedim(-1, -3), stats
