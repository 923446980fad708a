"""Costs of a forward pass, counted without data and without running it."""

import copy

import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensorMode

from asysplat.evaluation.cost import GB, count_parameters, module_flops, true_flops
from asysplat.scene import Cameras, Views

GIGA = 1e9


def blank_views(num_views: int, height: int, width: int) -> Views:
    """Make one scene's views with uninitialised content, on torch's default device."""
    intrinsics, poses = torch.empty(1, num_views, 3, 3), torch.empty(1, num_views, 4, 4)
    images = torch.empty(1, num_views, 3, height, width)
    return Views(Cameras(intrinsics, poses, height, width), images)


def static_costs(net: nn.Module, num_views: int, height: int, width: int) -> dict[str, float | int]:
    """Count the costs of the forward pass of one scene.

    Args:
        net: on any device; a copy on the meta device is measured.
        num_views, height, width: of the input.

    Returns:
        parameters; geometry_share, of 1; gflops as the paper counts them (`module_flops`) and
        gflops_true (`true_flops`), in 1e9; gaussians, their number; activation_gb (the function).
    """
    on_meta = copy.deepcopy(net).to("meta")
    with torch.device("meta"):
        views = blank_views(num_views, height, width)
    modules, gaussians = 0, 0

    def forward() -> None:
        nonlocal gaussians
        gaussians = on_meta(views).num_gaussians

    def counted_forward() -> None:
        nonlocal modules
        modules = module_flops(on_meta, forward)

    with torch.no_grad():
        everything = true_flops(counted_forward)
    return {
        "parameters": count_parameters(net),
        "geometry_share": net.geometry_share(),
        "gflops": modules / GIGA,
        "gflops_true": everything / GIGA,
        "gaussians": gaussians,
        "activation_gb": activation_gb(on_meta, num_views, height, width),
    }


def forward_flops(net: nn.Module, num_views: int, height: int, width: int) -> int:
    """Count the `true_flops` of the forward pass of one scene, on the meta device."""
    on_meta = copy.deepcopy(net).to("meta")
    with torch.device("meta"), torch.no_grad():
        return true_flops(lambda: on_meta(blank_views(num_views, height, width)))


def activation_gb(net: nn.Module, num_views: int, height: int, width: int) -> float:
    """Count the memory that one scene's forward pass keeps for its backward, in 1e9 bytes.

    In fp32, without gradient checkpointing, without the parameters, with attention that keeps no
    scores. Counted on fake tensors of the CPU, which have no content.
    """
    kept: dict[int, torch.UntypedStorage] = {}
    with FakeTensorMode():
        tensors = dict([*net.named_parameters(), *net.named_buffers()])
        state = {name: torch.empty(t.shape, dtype=t.dtype) for name, t in tensors.items()}
        for name, _ in net.named_parameters():
            state[name].requires_grad_()
        own = {tensor.untyped_storage()._cdata for tensor in state.values()}

        def keep(tensor: Tensor) -> Tensor:
            storage = tensor.untyped_storage()
            if storage._cdata not in own:
                kept[storage._cdata] = storage
            return tensor

        views = blank_views(num_views, height, width)
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            torch.func.functional_call(net, state, (views,))
        return sum(storage.nbytes() for storage in kept.values()) / GB
