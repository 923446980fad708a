"""Bytes that the operators of a block of the network read and write on a GPU, without one.

The tensors are fake: they have shapes, types and a device, and nothing is computed.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.func import functional_call
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from asysplat.models.attention import SparseAttention
from asysplat.models.layers import StageShape
from asysplat.models.links import CoarseToFine, FineToCoarse
from asysplat.models.mamba import BiMamba2, MambaVision
from benchmarks.timing import Result

# Operators that launch nothing.
FREE = {"view", "_unsafe_view", "expand", "permute", "transpose", "t", "slice", "select", "unbind"}
FREE |= {"unsqueeze", "squeeze", "detach", "alias", "as_strided", "split", "split_with_sizes"}
FREE |= {"diagonal", "unfold", "_reshape_alias", "is_same_size", "unflatten", "promote_types"}
FREE |= {"empty", "empty_like", "new_empty", "empty_strided", "new_empty_strided"}
FAKE = {"device", "lift_fresh"}  # asked of fake tensors alone


VIEWS, SIDE = 32, 16  # of coarse tokens; fine ones are twice as many along a side
COARSE, FINE = StageShape(896, 64, 4), StageShape(256, 64, 4)  # the paper's
# Blocks, by their letters, and what they take: c, coarse tokens, and f, fine ones.
BLOCKS: dict[str, tuple[Callable[[], nn.Module], str]] = {
    "m, Mamba2 both ways": (lambda: BiMamba2(COARSE), "c"),
    "s, sparse attention": (lambda: SparseAttention(COARSE), "c"),
    "MambaVision": (lambda: MambaVision(FINE), "f"),
    "fine to coarse": (lambda: FineToCoarse(COARSE, FINE), "cf"),
    "coarse to fine": (lambda: CoarseToFine(COARSE, FINE), "fc"),
}


class _Traffic(TorchDispatchMode):
    """Counts operators that launch something, and the bytes of what they read and write."""

    def __init__(self):
        super().__init__()
        self.operators = self.bytes = 0

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        results = operator(*args, **(kwargs or {}))
        if operator.overloadpacket.__name__ not in FREE | FAKE:
            tensors = filter(torch.is_tensor, tree_leaves((args, kwargs, results)))
            self.operators += 1
            self.bytes += sum(map(_size, tensors))
        return results


def _size(tensor: Tensor) -> int:
    """Count the bytes of a tensor; what is expanded is read once."""
    sides = zip(tensor.shape, tensor.stride(), strict=True)
    return tensor.element_size() * math.prod(side for side, stride in sides if stride)


@contextmanager
def _fake_gpu() -> Iterator[None]:
    """Let torch believe in a GPU, and operators choose its kernels; an attention is one."""
    attention = "torch.nn.functional.scaled_dot_product_attention"
    with ExitStack() as stack:
        stack.enter_context(FakeTensorMode(allow_non_fake_inputs=True))
        stack.enter_context(patch("torch.cuda.is_available", lambda: True))
        stack.enter_context(patch("torch.cuda.is_bf16_supported", lambda *_: True))
        stack.enter_context(patch(attention, lambda q, *_, **__: q.clone()))
        for operator in ("scan", "conv_silu"):
            place = f"asysplat.ops.{operator}.choose_fastest"
            stack.enter_context(patch(place, lambda *_: "cuda"))
        yield


def measure_blocks() -> list[Result]:
    """Count the operators of each block's forward pass in bf16, and their bytes per token."""
    rows = []
    for name, (make, takes) in BLOCKS.items():
        with torch.device("meta"):
            block = make()
        with _fake_gpu():
            state, inputs = block.state_dict(keep_vars=True), []
            for key, tensor in state.items():
                fake = torch.empty(tensor.shape, dtype=tensor.dtype, device="cuda")
                state[key] = nn.Parameter(fake, tensor.requires_grad)
            for kind in takes:
                shape, side = (COARSE, SIDE) if kind == "c" else (FINE, 2 * SIDE)
                tokens = (1, VIEWS, side, side, shape.width)
                inputs.append(torch.empty(tokens, device="cuda", requires_grad=True))
            with _Traffic() as traffic, torch.autocast("cuda", torch.bfloat16):
                functional_call(block, state, tuple(inputs))
        size = traffic.bytes / inputs[0][..., 0].numel()
        rows.append({"block": name, "operators": traffic.operators, "bytes": size})
    return rows
