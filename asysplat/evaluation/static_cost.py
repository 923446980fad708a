"""Count parameters and FLOPs; the costs of a forward pass on tensors without content."""

import copy
import math
from contextlib import ExitStack
from typing import Any

import torch
from torch import Tensor, UntypedStorage, nn
from torch._subclasses import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from asysplat.models.layers import Layers
from asysplat.scene import Cameras, Views

GIGA = 1e9
NORMS = (nn.LayerNorm, nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)


def count_parameters(module: nn.Module) -> int:
    """Count the scalars among the module's parameters, frozen ones included."""
    return sum(parameter.numel() for parameter in module.parameters())


def module_flops(net: nn.Module, inputs: object) -> tuple[int, Any]:
    """Count the FLOPs of `net(inputs)` as the paper counts them; return them and the output.

    2 x multiply-adds of Linear, Conv1d and Conv2d modules, 4 operations an element for LayerNorm
    and BatchNorm. Like a profiler of modules, it does not count attention products, scans, RMSNorm,
    activations, biases, and depthwise Conv1d (Mamba runs it in a fused kernel).
    """
    total = 0

    def count(module: nn.Module, _inputs: object, output: Tensor) -> None:
        nonlocal total
        total += output.numel() * _flops_per_output(module)

    with ExitStack() as hooks:
        for module in net.modules():
            if _flops_per_output(module):
                hooks.callback(module.register_forward_hook(count).remove)
        output = net(inputs)
    return total, output


def _flops_per_output(module: nn.Module) -> int:
    """Return what `module_flops` counts for one element of the module's output."""
    if isinstance(module, NORMS):
        return 4
    if isinstance(module, nn.Linear):
        return 2 * module.in_features
    if isinstance(module, nn.Conv1d) and module.groups == module.in_channels:
        return 0
    if isinstance(module, (nn.Conv1d, nn.Conv2d)):
        return 2 * module.in_channels // module.groups * math.prod(module.kernel_size)
    return 0


def blank_views(num_views: int, height: int, width: int) -> Views:
    """Create one scene's views with uninitialized content, on torch's default device."""
    intrinsics, poses = torch.empty(1, num_views, 3, 3), torch.empty(1, num_views, 4, 4)
    images = torch.empty(1, num_views, 3, height, width)
    return Views(Cameras(intrinsics, poses, height, width), images)


def static_costs(net: nn.Module, num_views: int, height: int, width: int) -> dict[str, float | int]:
    """Count the costs of the forward pass of one scene, on a copy on the meta device.

    Among them gflops as the paper counts them (`module_flops`), and gflops_true as `true_flops`.
    """
    on_meta, products = copy.deepcopy(net).to("meta"), FlopCounterMode(display=False)
    with torch.device("meta"), torch.no_grad(), products:
        flops, gaussians = module_flops(on_meta, blank_views(num_views, height, width))
    return {
        "parameters": count_parameters(net),
        "geometry_ratio": net.geometry_ratio(),
        "gflops": flops / GIGA,
        "gflops_true": products.get_total_flops() / GIGA,
        "gaussians": gaussians.num_gaussians,
        "activation_gb": activation_gb(on_meta, num_views, height, width),
    }


def true_flops(net: nn.Module, num_views: int, height: int, width: int) -> int:
    """Count the FLOPs of one scene's forward pass: matrix products, einsums, attention and scans.

    On the meta device, as torch's counter may not know the kernel elsewhere (some releases count
    attention on a CPU as 0). Other element-wise work is not counted.
    """
    on_meta, counter = copy.deepcopy(net).to("meta"), FlopCounterMode(display=False)
    with torch.device("meta"), torch.no_grad(), counter:
        on_meta(blank_views(num_views, height, width))
    return counter.get_total_flops()


def activation_gb(net: nn.Module, num_views: int, height: int, width: int) -> float:
    """Count what one scene's forward pass saves for the backward pass, in 1e9 bytes.

    In fp32 or the caller's autocast, without layer checkpointing and parameters, on fake CPU
    tensors; attention saves no scores.
    """
    storages: dict[int, UntypedStorage] = {}  # kept alive, so that no two share an address
    groups = [module for module in net.modules() if isinstance(module, Layers)]
    checkpointing = [group.checkpointing for group in groups]
    for group in groups:
        group.checkpointing = False
    with FakeTensorMode():
        tensors = dict([*net.named_parameters(), *net.named_buffers()])
        state = {name: torch.empty(t.shape, dtype=t.dtype) for name, t in tensors.items()}
        for name, _ in net.named_parameters():
            state[name].requires_grad_()
        state_storages = {tensor.untyped_storage()._cdata for tensor in state.values()}

        def save(tensor: Tensor) -> Tensor:
            storage = tensor.untyped_storage()
            if storage._cdata not in state_storages:
                storages[storage._cdata] = storage
            return tensor

        views = blank_views(num_views, height, width)
        with torch.autograd.graph.saved_tensors_hooks(save, lambda tensor: tensor):
            torch.func.functional_call(net, state, (views,))
    for group, was in zip(groups, checkpointing, strict=True):
        group.checkpointing = was
    return sum(storage.nbytes() for storage in storages.values()) / GIGA
