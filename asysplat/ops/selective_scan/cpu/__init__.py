"""The selective scan for CPUs (Numba): a state of 16 channels at a time.

A task walks through a sequence by chunks of tokens, and through a chunk by blocks of 16 channels,
one vector wide, one of the N states after the other: it stays in a register meanwhile. Nothing is
stored between the passes but the state at the beginning of each chunk; the backward pass walks
through a chunk once more before it walks back.
"""

from asysplat.ops.selective_scan.cpu.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
