"""SSD for CPUs (Numba): matrix products within chunks, the state passed on between them.

Dao and Gu 2024, Section 6. A task takes a head through a segment of chunks: its state and all
intermediate results stay in a core's cache. Only the state before each segment is stored between
the passes.
"""

from asysplat.ops.ssd.cpu.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
