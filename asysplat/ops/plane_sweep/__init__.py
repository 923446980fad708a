"""The kernels of the plane sweep: `cost_volume`, `sgm` and `consistency` of a backend's module.

cost_volume compares each pixel with its neighbors' at every plane (Collins 1996), sgm aggregates
the costs along the image's rows and columns (semi-global matching, Hirschmueller 2008), and
consistency counts how many other views confirm each depth. `asysplat.models.prior.plane_sweep`
makes depths from them.
"""

from types import ModuleType

from torch import Tensor
from torch._subclasses.fake_tensor import is_fake

from asysplat.kernels.dispatch import (
    FAST,
    check_fast_backend,
    fast_backend,
    load_kernels,
    pick_backend,
)
from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.reference import BestPlane, Consistency

__all__ = ["BestPlane", "Consistency", "choose_backend", "load_backend"]


def choose_backend(backend: str, x: Tensor) -> str:
    """Return the backend's name; for "auto" that of x's device, "reference" for float64.

    Raises:
        InputError: an unknown name, or a backend that cannot take x.
    """
    pick_backend("plane_sweep", dict.fromkeys(("auto", "reference", *FAST)), backend)
    if backend == "auto":
        return fast_backend(x, "reference")
    if backend != "reference":
        check_fast_backend("plane_sweep", backend, x)
    return backend


def load_backend(backend: str, x: Tensor) -> ModuleType:
    """Return the module that computes with x; for a tensor without content, the reference."""
    name = "reference" if x.is_meta or is_fake(x) else choose_backend(backend, x)
    return reference if name == "reference" else load_kernels("plane_sweep", name)
