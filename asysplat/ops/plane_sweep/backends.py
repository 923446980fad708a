"""Where `match`, `smooth` and `count_votes` are: in torch, and as kernels."""

from types import ModuleType

from torch import Tensor

from asysplat.ops.dispatch import FAST, check_fast_backend, fast_backend, pick_backend
from asysplat.ops.plane_sweep import reference


def choose(backend: str, x: Tensor) -> str:
    """Return the name of a back end; of "auto" the fast one for x, "reference" for float64.

    Raises:
        InputError: an unknown name, or a back end that cannot take x.
    """
    pick_backend("plane_sweep", dict.fromkeys(("auto", "reference", *FAST)), backend)
    if backend == "auto":
        return fast_backend(x, "reference")
    if backend != "reference":
        check_fast_backend("plane_sweep", backend, x)
    return backend


def load(backend: str, x: Tensor) -> ModuleType:
    """Return the back end that computes with x; on a device without content, that in torch."""
    name = "reference" if x.is_meta else choose(backend, x)
    if name == "cpu":
        from asysplat.ops.plane_sweep import cpu

        return cpu
    if name == "cuda":
        from asysplat.ops.plane_sweep import cuda

        return cuda
    return reference
