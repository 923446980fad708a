"""The selective scan for GPUs (Triton): chunks of a few tokens in parallel, states in registers.

The first kernel computes what each chunk adds to the state, the second passes the states from chunk
to chunk, and the third computes the outputs of all chunks. The backward pass does the same from the
other end. A long sequence is scanned a segment at a time, so that only what one segment needs, and
the first states of all, are in memory.
"""

from asysplat.ops.selective_scan.cuda.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
