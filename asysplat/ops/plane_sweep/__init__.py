"""The operators of the plane sweep; each backend is a module with all four.

`cost_volume` compares the patch around each pixel with neighboring views at every plane (Collins
1996), `sgm` aggregates the costs along the image's rows and columns (semi-global matching,
Hirschmueller 2008), `consistency` counts the other views that confirm or contradict each depth, and
`spread` sums what is known around each pixel.
`asysplat.models.prior.plane_sweep` computes depths from their results.
"""

from types import ModuleType

from torch import Tensor
from torch._subclasses.fake_tensor import is_fake

from asysplat.kernels.dispatch import (
    KERNEL_BACKENDS,
    check_kernel_backend,
    choose_fastest,
    load_kernels,
    look_up_backend,
)
from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.reference import BestPlane, Consistency

__all__ = ["BestPlane", "Consistency", "choose_backend", "load_backend"]


def choose_backend(backend: str, x: Tensor) -> str:
    """Return the backend's name; for "auto", that of x's device, or "reference" for float64."""
    look_up_backend("plane_sweep", dict.fromkeys(("auto", "reference", *KERNEL_BACKENDS)), backend)
    if backend == "auto":
        return choose_fastest(x, "reference", "asysplat.ops.self_check:plane_sweep")
    if backend != "reference":
        check_kernel_backend("plane_sweep", backend, x)
    return backend


def load_backend(backend: str, x: Tensor) -> ModuleType:
    """Return the backend's module; the reference if x has no content (meta or fake tensors)."""
    name = "reference" if x.is_meta or is_fake(x) else choose_backend(backend, x)
    return reference if name == "reference" else load_kernels("plane_sweep", name)
