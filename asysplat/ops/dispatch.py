"""What the operators have in common: picking a back end, and how a scan is entered and left."""

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import TypeVar

import torch
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.precision import without_autocast

Form = TypeVar("Form")
FAST = ("cpu", "cuda")


def pick_backend(operator: str, backends: Mapping[str, Form], backend: str) -> Form:
    """What `backend` names, a function or a module, or InputError with the names there are."""
    if backend not in backends:
        raise InputError(f"{operator} backend={backend!r}: expected one of {', '.join(backends)}.")
    return backends[backend]


def run_scan(
    scan: str,
    forms: Mapping[str, Callable[..., Tensor]],
    operator: Callable[..., Tensor],
    backend: str,
    arguments: tuple[Tensor, ...],
    reverse: bool,
) -> Tensor:
    """Run a scan over dimension 1, in fp32 at least, backwards if asked.

    Args:
        scan: its name.
        forms: those in torch, of (x, dt, A, B, C, D), by name.
        operator: the fast ones, see `scan_operator`.
        arguments: x, dt, A, B, C, D, of any float types; y has that of x.

    Raises:
        InputError: an unknown backend, or one that cannot take these tensors; shapes or devices
            that do not go together; integers; no token.
    """
    x, dt, A, B, C, D = arguments
    _check(scan, arguments)
    if backend == "auto":
        backend = _fast_backend(x)
    if backend in FAST:
        _check_fast(scan, backend, x)
        with without_autocast(x):
            return operator(
                backend,
                x.contiguous(),
                dt.float().contiguous(),
                A.float(),
                B.to(x.dtype).contiguous(),
                C.to(x.dtype).contiguous(),
                D.float(),
                reverse,
            )
    form = pick_backend(scan, {"auto": None, **forms, **dict.fromkeys(FAST)}, backend)
    dtype = torch.promote_types(x.dtype, torch.float32)

    def sequence(tensor: Tensor) -> Tensor:
        return (tensor.flip(1) if reverse else tensor).to(dtype)

    with without_autocast(x):
        y = form(sequence(x), sequence(dt), A.to(dtype), sequence(B), sequence(C), D.to(dtype))
    return (y.flip(1) if reverse else y).to(x.dtype)


def _fast_backend(x: Tensor) -> str:
    """The fastest for the device, that keeps what float64 asks for; the meta device has any."""
    if x.dtype == torch.float64:
        return "chunked"
    if x.device.type in ("cpu", "meta"):
        return "cpu"
    if x.device.type == "cuda" and find_spec("triton"):
        return "cuda"
    return "chunked"


def _check(scan: str, arguments: tuple[Tensor, ...]) -> None:
    x, dt, A, B, C, D = arguments
    axes = "[B, L, H, P]" if scan == "ssd" else "[B, L, D]"
    if x.ndim != axes.count(",") + 1:
        raise InputError(f"{scan}'s x has shape {tuple(x.shape)}: expected {axes}.")
    batch, length, *channels = x.shape
    state_size = B.shape[-1]
    rows = (channels[0],) if scan == "ssd" else (channels[0], state_size)
    expected = {
        "dt": (dt, (batch, length, channels[0])),
        "A": (A, rows),
        "B": (B, (batch, length, state_size)),
        "C": (C, (batch, length, state_size)),
        "D": (D, (channels[0],)),
    }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise InputError(
                f"{scan}'s {name} has shape {tuple(tensor.shape)}: expected {shape}, as x has "
                f"shape {tuple(x.shape)} and B {tuple(B.shape)}."
            )
        if tensor.device != x.device:
            raise InputError(
                f"{scan}'s {name} is on {tensor.device} and x on {x.device}: move both to one "
                "device."
            )
    for name, tensor in zip(("x", *expected), arguments, strict=True):
        if not tensor.is_floating_point():
            raise InputError(f"{scan}'s {name} is {tensor.dtype}: give floating-point numbers.")
    if x.numel() == 0 or B.numel() == 0:
        raise InputError(
            f"{scan}'s x has shape {tuple(x.shape)} and B {tuple(B.shape)}: every side must be at "
            "least 1."
        )


def _check_fast(scan: str, backend: str, x: Tensor) -> None:
    if x.dtype == torch.float64:
        raise InputError(
            f"{scan}'s backend {backend!r} computes in float32 and x is float64: choose 'chunked', "
            "or give float32."
        )
    if x.device.type not in (backend, "meta") and not _interpreted(backend):
        raise InputError(
            f"{scan}'s backend is {backend!r} and x is on {x.device}: choose 'auto', or move it "
            f"with .to('{backend}')."
        )
    if backend == "cuda" and not find_spec("triton"):
        raise InputError(f"{scan}'s backend 'cuda' needs triton: pip install triton.")


def _interpreted(backend: str) -> bool:
    """Whether Triton interprets its kernels, on a CPU: for tests."""
    if backend != "cuda" or not find_spec("triton"):
        return False
    import triton

    return triton.knobs.runtime.interpret
