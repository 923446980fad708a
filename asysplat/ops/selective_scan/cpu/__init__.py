"""The selective scan for CPUs (Numba): the states of 16 channels at a time.

A task divides a sequence into chunks of tokens and a chunk into blocks of 16 channels, the width of
a vector. It takes one of a block's N states at a time through the chunk, in a register. Only the
states at the start of each chunk are stored between the passes; the backward pass computes each
chunk's other states again.
"""

from asysplat.ops.selective_scan.cpu.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
