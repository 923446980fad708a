"""The work of our kernels by well-known libraries, where these are installed; none is required.

Each function copies inputs to the library's layout, and returns a function that runs both passes
and returns the output in our layout.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

import torch
from einops import rearrange
from torch import Tensor

from asysplat.scene import Cameras, Gaussians

LIBRARIES = ("gsplat", "mamba_ssm", "flash_attn")
CHUNK = 256  # tokens of a chunk in Mamba2's own configuration
Run = Callable[[], Tensor]


def has_library(name: str) -> bool:
    """Return whether a library is installed."""
    return find_spec(name) is not None


def describe_library(name: str) -> str:
    """Name a library and its version."""
    if not has_library(name):
        return f"{name} not installed"
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return f"{name} of unknown version"


def render_by_gsplat(gaussians: Gaussians, cameras: Cameras, weights: Tensor | None) -> Run:
    """Render by gsplat's `rasterization`.

    Args:
        weights: gradient of the images [V, 3, H, W]; None: no backward pass.
    """
    rasterization = import_module("gsplat").rasterization
    names = {"means": "means", "quats": "quats", "scales": "scales", "opacities": "opacities"}
    names |= {"colors": "sh"}
    leaves = {theirs: _leaf(getattr(gaussians, ours)) for theirs, ours in names.items()}
    options = {"viewmats": cameras.cam_to_world.inverse(), "Ks": cameras.intrinsics}
    options |= {"width": cameras.width, "height": cameras.height}
    options["sh_degree"] = int(gaussians.sh.shape[-2] ** 0.5) - 1
    grad_output = None if weights is None else weights.movedim(-3, -1).contiguous()

    def run() -> Tensor:
        with torch.set_grad_enabled(weights is not None):
            images = rasterization(**leaves, **options)[0]
        return _backward(images, list(leaves.values()), grad_output).movedim(-1, -3)

    return run


def ssd_by_mamba(inputs: dict[str, Tensor], weights: Tensor) -> Run:
    """Scan by mamba_ssm's `mamba_chunk_scan_combined`; see `asysplat.ops.ssd`."""
    scan = import_module("mamba_ssm.ops.triton.ssd_combined").mamba_chunk_scan_combined
    leaves = {name: _leaf(t[:, :, None] if name in "BC" else t) for name, t in inputs.items()}

    def run() -> Tensor:
        return _backward(scan(**leaves, chunk_size=CHUNK), list(leaves.values()), weights)

    return run


def selective_scan_by_mamba(inputs: dict[str, Tensor], weights: Tensor) -> Run:
    """Scan by mamba_ssm's `selective_scan_fn`; see `asysplat.ops.selective_scan`."""
    scan = import_module("mamba_ssm.ops.selective_scan_interface").selective_scan_fn
    # It takes [B, C, L], and the steps in the type of x.
    u, delta, B, C = (_leaf(inputs[name].to(weights.dtype).mT) for name in ("x", "dt", "B", "C"))
    A, D = (_leaf(inputs[name]) for name in "AD")
    grad_output = weights.mT.contiguous()

    def run() -> Tensor:
        y = scan(u, delta, A, B, C, D)
        return _backward(y, [u, delta, A, B, C, D], grad_output).mT

    return run


def grid_attention_by_flash(inputs: dict[str, Tensor], weights: Tensor, grid: int) -> Run:
    """Attend by flash_attn's `flash_attn_func`, with tokens in the order of the grid's places."""
    attend = import_module("flash_attn").flash_attn_func
    ours = "b v (h gh) (w gw) H p"
    theirs = "(b gh gw) (v h w) H p"
    sizes = {"gh": grid, "gw": grid}
    leaves = [
        _leaf(rearrange(tensor, f"{ours} -> {theirs}", **sizes)) for tensor in inputs.values()
    ]
    grad_output = rearrange(weights, f"{ours} -> {theirs}", **sizes).contiguous()
    b, v, h = weights.shape[:3]

    def run() -> Tensor:
        output = _backward(attend(*leaves), leaves, grad_output)
        return rearrange(output, f"{theirs} -> {ours}", b=b, v=v, h=h // grid, **sizes)

    return run


def _leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().contiguous().requires_grad_()


def _backward(output: Tensor, leaves: list[Tensor], grad_output: Tensor | None) -> Tensor:
    """Compute the gradients of the leaves, if there is a gradient of the output; return it."""
    if grad_output is not None:
        torch.autograd.grad(output, leaves, grad_output)
    return output.detach()
