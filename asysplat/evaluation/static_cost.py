"""Count the costs of a forward pass without data, on tensors without content."""

import copy
from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor, UntypedStorage, nn
from torch._subclasses import FakeTensorMode

from asysplat.evaluation.cost import GB, count_parameters, module_flops, true_flops
from asysplat.models.layers import Layers
from asysplat.scene import Cameras, Views

GIGA = 1e9


def blank_views(num_views: int, height: int, width: int) -> Views:
    """Create one scene's views with uninitialized content, on torch's default device."""
    intrinsics, poses = torch.empty(1, num_views, 3, 3), torch.empty(1, num_views, 4, 4)
    images = torch.empty(1, num_views, 3, height, width)
    return Views(Cameras(intrinsics, poses, height, width), images)


def static_costs(net: nn.Module, num_views: int, height: int, width: int) -> dict[str, float | int]:
    """Count the costs of the forward pass of one scene.

    Args:
        net: on any device; its costs are counted on a copy on the meta device.
        num_views, height, width: of the input.

    Returns:
        parameters; geometry_share, of 1; gflops as the paper counts them (`module_flops`) and
        gflops_true (`true_flops`), in 1e9; gaussians, their number; activation_gb, see
        `Activations`, without checkpointing.
    """
    on_meta = copy.deepcopy(net).to("meta")
    with torch.device("meta"):
        views = blank_views(num_views, height, width)
    modules, gaussians = 0, None

    def forward() -> None:
        nonlocal gaussians
        gaussians = on_meta(views)

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
        "gaussians": gaussians.num_gaussians,
        "activation_gb": count_activations(on_meta, num_views, height, width).saved,
    }


def forward_flops(net: nn.Module, num_views: int, height: int, width: int) -> int:
    """Count the `true_flops` of the forward pass of one scene, on the meta device."""
    on_meta = copy.deepcopy(net).to("meta")
    with torch.device("meta"), torch.no_grad():
        return true_flops(lambda: on_meta(blank_views(num_views, height, width)))


@dataclass(frozen=True)
class Activations:
    """Memory of one scene's activations, saved for the backward pass, in 1e9 bytes.

    Args:
        saved: all of them.
        checkpointed: with layer checkpointing: outside the layers, between them, and within the
            largest layer.
    """

    saved: float
    checkpointed: float


def activation_gb(net: nn.Module, num_views: int, height: int, width: int) -> float:
    """Count one scene's activations, with checkpointing if the network's layers have it."""
    activations = count_activations(net, num_views, height, width)
    checkpointing = any(isinstance(m, Layers) and m.checkpointing for m in net.modules())
    return activations.checkpointed if checkpointing else activations.saved


def count_activations(net: nn.Module, num_views: int, height: int, width: int) -> Activations:
    """Count one scene's activations, on fake CPU tensors, which have no content.

    They are in fp32, or in the caller's autocast; parameters are not counted, and attention saves
    no scores.
    """
    saved: dict[int, tuple[int, nn.Module | None]] = {}  # storage -> its bytes and its layer
    inputs: dict[int, int] = {}  # storage -> bytes, of the layers' inputs
    storages: list[UntypedStorage] = []  # kept alive, so that no two share an address
    current: list[nn.Module] = []  # the layer that computes now

    def enter(layer: nn.Module, arguments: tuple[Tensor]) -> None:
        storage = arguments[0].untyped_storage()
        storages.append(storage)
        inputs[storage._cdata] = storage.nbytes()
        current.append(layer)

    def save(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in own:
            storages.append(storage)
            layer = current[-1] if current else None
            saved.setdefault(storage._cdata, (storage.nbytes(), layer))
        return tensor

    groups = [module for module in net.modules() if isinstance(module, Layers)]
    layers = [layer for group in groups for layer in group]
    hooks = [layer.register_forward_pre_hook(enter) for layer in layers]
    hooks += [layer.register_forward_hook(lambda *_: current.pop() and None) for layer in layers]
    checkpointing = [group.checkpointing for group in groups]
    try:
        for group in groups:
            group.checkpointing = False
        with FakeTensorMode():
            tensors = dict([*net.named_parameters(), *net.named_buffers()])
            state = {name: torch.empty(t.shape, dtype=t.dtype) for name, t in tensors.items()}
            for name, _ in net.named_parameters():
                state[name].requires_grad_()
            own = {tensor.untyped_storage()._cdata for tensor in state.values()}
            views = blank_views(num_views, height, width)
            with torch.autograd.graph.saved_tensors_hooks(save, lambda tensor: tensor):
                torch.func.functional_call(net, state, (views,))
    finally:
        for hook in hooks:
            hook.remove()
        for group, was in zip(groups, checkpointing, strict=True):
            group.checkpointing = was
    by_layer = Counter()
    for size, layer in saved.values():
        by_layer[layer] += size
    outside = by_layer.pop(None, 0)
    between = sum(size for at, size in inputs.items() if saved.get(at, (0, at))[1] is not None)
    checkpointed = outside + between + max(by_layer.values(), default=0)
    return Activations((outside + by_layer.total()) / GB, checkpointed / GB)
