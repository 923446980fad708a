"""The selective scan for CPUs (Numba): the states of 16 channels at a time.

A task goes through a sequence in chunks of tokens, through a chunk in blocks of 16 channels, one
vector wide, and through a block one of the N states at a time, which stays in a register. Only the
state at the start of each chunk is stored between the passes; the backward pass computes each
chunk's states again.
"""

from asysplat.ops.selective_scan.cpu.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
