"""SSD for GPUs (Triton): matrix products within chunks, the state passed on between them.

Dao and Gu 2024, Section 6. Log decays are differences of sums from the chunk's start, each kept in
two fp32 numbers, to 48 bits; every exponent is <= 0. The backward pass needs only the inputs.
"""

from asysplat.ops.ssd.cuda.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
