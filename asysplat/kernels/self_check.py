"""A check of an operator's GPU kernels on the GPU at hand, before their results are used.

GPUs, drivers and compilers differ, and few have been seen. Where kernels do not compile or return
wrong numbers, torch computes the operator instead, and a warning says so.
"""

import hashlib
import json
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple

import torch
from torch import Tensor

TOLERANCE = 1e-3  # greatest relative error: rounding makes 1e-5, a wrong kernel far more
MAX_REASON = 300  # characters of a compiler's message
DRIVER = Path("/proc/driver/nvidia/version")
Check = Callable[[torch.device, str], dict[str, float]]  # see `are_kernels_right`


class KernelResults(NamedTuple):
    """The results of an operator that are compared."""

    outputs: Sequence[Tensor]
    gradients: Sequence[Tensor] = ()


def are_kernels_right(check: str, device: torch.device) -> bool:
    """Check kernels on their first use on a GPU, or read the verdict of an earlier process.

    A verdict holds for one kind of GPU, driver, version of torch and Triton, and source. `check`
    names, as "module:name", a function that takes a device and the name of a backend, runs an
    operator's kernels and their reference, and returns `relative_errors`.
    """
    # Nothing can be compared while a compiler traces or a graph is captured.
    if torch.compiler.is_compiling() or torch.cuda.is_current_stream_capturing():
        return True
    return not find_fault(check, device)


@cache
def find_fault(check: str, device: torch.device) -> str:
    """Return what is wrong with kernels, after a warning; "" if nothing is."""
    from asysplat.kernels.simd import threads  # slow to load

    operator, gpu = check.rpartition(":")[2], describe_gpu(device)
    name = hashlib.sha256(f"{check} {gpu} {threads.hash_sources()}".encode()).hexdigest()[:16]
    folder = threads.find_home_cache()
    file = folder and folder / f"self-check-{operator}-{name}.json"
    fault = _read_verdict(file)
    if fault is None:
        fault = _compare(resolve_name(check), device)
        if file is not None:
            with suppress(OSError):  # a full disk: the next process checks again
                file.write_text(json.dumps({"gpu": gpu, "fault": fault}, indent=1))
    if fault:
        warnings.warn(
            f"{operator}'s kernels {fault} on {gpu}: torch computes it, which is slower. Please "
            f"report this; remove {file} to check again, or insist with backend='cuda'.",
            stacklevel=2,
        )
    return fault


def relative_errors(results: KernelResults, exact: KernelResults) -> dict[str, float]:
    """Return the largest relative errors of "outputs" and, where there are any, "gradients"."""
    pairs = zip(KernelResults._fields, results, exact, strict=True)
    return {name: relative_error(tensors, true) for name, tensors, true in pairs if tensors}


def relative_error(tensors: Sequence[Tensor], exact: Sequence[Tensor]) -> float:
    """Return the largest of the relative L2 errors of tensors; NaN where one has NaN."""
    errors = [
        (a.double() - b.double()).norm() / b.double().norm().clamp_min(1e-30)
        for a, b in zip(tensors, exact, strict=True)
    ]
    return torch.stack(errors).max().item()


def describe_errors(errors: Mapping[str, float]) -> str:
    """Say how wrong kernels are; "" if no error exceeds TOLERANCE."""
    wrong = [error for error in errors.values() if not error <= TOLERANCE]
    return f"have a relative error of {max(wrong):.1e}" if wrong else ""


def describe_failure(failure: Exception) -> str:
    """Return the type and the first line of an exception."""
    return f"{type(failure).__name__}: {failure}".partition("\n")[0][:MAX_REASON]


def seeded_normal(device: torch.device, dtype: torch.dtype) -> Callable[..., Tensor]:
    """Return a function that samples normal numbers: the same sequence for all types."""
    generator = torch.Generator().manual_seed(0)
    return lambda *shape: torch.randn(shape, generator=generator).to(device, dtype)


def describe_gpu(device: torch.device) -> str:
    """Name a GPU, its driver, and the versions of torch and Triton."""
    card = torch.cuda.get_device_properties(device)
    driver = re.search(r"\d+\.\d+[\d.]*", DRIVER.read_text()) if DRIVER.exists() else None
    return (
        f"{card.name} (compute capability {card.major}.{card.minor}, driver "
        f"{driver[0] if driver else 'unknown'}, torch {torch.__version__}, Triton "
        f"{version('triton') if find_spec('triton') else 'not installed'})"
    )


def _read_verdict(file: Path | None) -> str | None:
    try:
        return None if file is None else str(json.loads(file.read_text())["fault"])
    except (OSError, ValueError, KeyError, TypeError):  # none yet, or a damaged one
        return None


def _compare(check: Check, device: torch.device) -> str:
    """Run a check; return what is wrong, or ""."""
    plain = torch.autocast(device.type, enabled=False)
    try:
        with torch.inference_mode(False), torch.enable_grad(), plain:
            return describe_errors(check(device, "cuda"))
    except torch.OutOfMemoryError:
        raise  # says nothing about the kernels
    except Exception as failure:  # compilers and drivers raise many kinds
        return f"do not run ({describe_failure(failure)})"
