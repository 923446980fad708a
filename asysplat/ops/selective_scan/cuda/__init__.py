"""The selective scan for GPUs (Triton): chunks of a few tokens, all at once, states in registers.

What each chunk adds to the state is found first, then passed on from chunk to chunk; with the
state before it, a chunk is on its own. The backward pass does the same from the other end.
"""

from asysplat.ops.selective_scan.cuda.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
