"""Copies between the host and a GPU for which neither waits."""

from collections.abc import Sequence

import torch
from torch import Tensor


class HostCopy:
    """The numbers of a tensor on their way to the host, which waits where it reads them."""

    def __init__(self, numbers: Tensor):
        self._numbers = numbers.to("cpu", non_blocking=True)  # into pinned memory
        stream = torch.cuda.current_stream(numbers.device) if numbers.is_cuda else None
        self._arrival = stream and stream.record_event()

    def read(self) -> Tensor:
        """Return the numbers on the CPU."""
        if self._arrival is not None:
            self._arrival.synchronize()
        return self._numbers


def copy_to(device: torch.device, numbers: Sequence[float], dtype: torch.dtype) -> Tensor:
    """Return the host's numbers on a device."""
    pinned = torch.tensor(numbers, dtype=dtype, pin_memory=device.type == "cuda")
    return pinned.to(device, non_blocking=True)
