"""What a forward pass is made of: layers by their kind, and the operators within them."""

from collections import Counter
from types import FrameType

from asysplat import models, ops
from asysplat.benchmark.model.workload import Workload
from asysplat.benchmark.products import Product, RecordProducts
from asysplat.benchmark.timing import seconds_of, time_calls, watch_calls
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
OPERATORS = ("ssd", "selective_scan", "grid_attention")


def _component(frame: FrameType) -> str | None:
    """Name the component whose forward pass this is; None for a layer within another."""
    layer = frame.f_locals["self"]
    found = (name for name, kinds in COMPONENTS.items() if isinstance(layer, kinds))
    return next(found, None)


LAYERS = {kind.forward: _component for kinds in COMPONENTS.values() for kind in kinds}


def component_seconds(workload: Workload) -> dict[str, float]:
    """Time one forward pass in each of COMPONENTS, in OTHERS, and, again, in each of OPERATORS."""
    operators = {getattr(ops, name): lambda _, name=name: name for name in OPERATORS}
    with time_calls(LAYERS | operators, workload.device) as seconds:
        total = seconds_of(workload.forward, workload.device)
    return seconds | {OTHERS: total - sum(seconds.get(name, 0) for name in COMPONENTS)}


def record_products(workload: Workload) -> dict[str, Counter[Product]]:
    """Count the products of one forward pass, by component."""
    recorder = RecordProducts(OTHERS)

    def label(name: str) -> None:
        recorder.label = name

    with watch_calls(LAYERS, label, lambda _: label(OTHERS)), recorder:
        workload.forward()
    return recorder.counts
