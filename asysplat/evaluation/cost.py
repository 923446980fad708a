"""Count parameters and FLOPs, read peak memory."""

import ctypes
import gc
import math
import os
import re
import resource
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

GB = 1e9
STATUS, CLEAR_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")  # Linux alone
NORMS = (nn.LayerNorm, nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)


def count_parameters(module: nn.Module) -> int:
    """Count the scalars among the module's parameters, frozen ones included."""
    return sum(parameter.numel() for parameter in module.parameters())


def module_flops(net: nn.Module, run: Callable[[], object]) -> int:
    """Count the FLOPs of one `run()`, which calls `net`, as the paper counts them.

    2 x multiply-adds of Linear, Conv1d and Conv2d modules, 4 operations an element for LayerNorm
    and BatchNorm. Like a profiler of modules, it does not count attention products, scans, RMSNorm,
    activations, biases, and depthwise Conv1d (Mamba runs it in a fused kernel). Works on the meta
    device.
    """
    total = 0

    def count(module: nn.Module, _inputs: object, output: Tensor) -> None:
        nonlocal total
        total += output.numel() * _flops_per_output(module)

    counted = [module for module in net.modules() if _flops_per_output(module)]
    hooks = [module.register_forward_hook(count) for module in counted]
    try:
        run()
    finally:
        for hook in hooks:
            hook.remove()
    return total


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


def true_flops(run: Callable[[], object]) -> int:
    """Count the FLOPs of one `run()`: every matrix product, einsum, attention and scan.

    Run it on the meta device, which needs no memory; elsewhere torch's counter may not know the
    kernel (some releases count attention on a CPU as 0). Other element-wise work is not counted.
    """
    with FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops()


def memory_gb(device: torch.device | str) -> float:
    """Return the memory of the device in 1e9 bytes; for a CPU, that of the machine."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory / GB
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GB


def reset_peak_memory(device: torch.device | str) -> bool:
    """Reset the peak that `peak_memory_gb` reads to the memory in use now.

    Returns:
        Whether the peak was reset: on CUDA, and on Linux if /proc is writable.
    """
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return True
    try:
        CLEAR_PEAK.write_text("5")
    except OSError:
        return False
    return True


def memory_before_gb(device: torch.device | str) -> float:
    """Return freed memory to the system, reset the peak, and return the memory in use now.

    Without this, work that reuses freed memory would not raise the peak.
    """
    gc.collect()
    with suppress(OSError, AttributeError):  # only glibc has it
        ctypes.CDLL(None).malloc_trim(0)
    reset_peak_memory(device)
    return peak_memory_gb(device)


def peak_memory_gb(device: torch.device | str) -> float:
    """Read the peak memory in 1e9 bytes since `reset_peak_memory` or the process's start.

    On CUDA this is the memory of the tensors; elsewhere the resident set of the whole process, with
    libraries, data, and freed memory that was not returned to the system.
    """
    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated(device) / GB
    if STATUS.exists():
        kilobytes = re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())[1]
        return int(kilobytes) * 1024 / GB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    return peak * bytes_per_unit / GB
