"""What a forward pass is made of: layers by their kind, and the operators within them."""

import sys
from collections import Counter
from collections.abc import Callable
from traceback import walk_stack
from types import FrameType

import torch

from asysplat import models, ops
from asysplat.benchmark.products import Product, RecordProducts
from asysplat.benchmark.timing import seconds_of, time_calls
from asysplat.models.tokenizer import Tokenizer

COMPONENTS = {  # none within another
    "tokenizer": (Tokenizer,),
    "Mamba2": (models.BiMamba2,),
    "sparse attention": (models.SparseAttention,),
    "full attention": (models.FullAttention,),
    "MambaVision": (models.MambaVision,),
    "cross-attention": (models.CoarseReadsFine, models.FineReadsCoarse),
    "head": (models.GaussianHead,),
}
OTHERS = "others"
PARTS = (*COMPONENTS, OTHERS)
OPERATORS = ("ssd", "selective_scan", "grid_attention")


def _component(frame: FrameType) -> str | None:
    """Name the component that a frame is a method of; None where it is of no component's."""
    layer = frame.f_locals.get("self")
    return next((name for name, kinds in COMPONENTS.items() if isinstance(layer, kinds)), None)


LAYERS = {kind.forward: _component for kinds in COMPONENTS.values() for kind in kinds}


def part_seconds(forward: Callable[[], object], device: torch.device) -> dict[str, float]:
    """Time one forward pass in each of PARTS and, again, in each of OPERATORS."""
    operators = {getattr(ops, name): lambda _, name=name: name for name in OPERATORS}
    with time_calls(LAYERS | operators, device) as seconds:
        total = seconds_of(forward, device)
    return seconds | {OTHERS: total - sum(seconds.get(name, 0) for name in COMPONENTS)}


def record_products(forward: Callable[[], object]) -> dict[str, Counter[Product]]:
    """Count the products of one forward pass: in each of PARTS that has some; "forward", in all."""

    def running() -> str:
        names = (_component(frame) for frame, _ in walk_stack(sys._getframe()))
        return next(filter(None, names), OTHERS)

    with RecordProducts(running) as recorder:
        forward()
    return recorder.counts | {"forward": sum(recorder.counts.values(), Counter())}
