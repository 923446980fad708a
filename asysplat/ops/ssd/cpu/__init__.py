"""SSD for CPUs (Numba): matrix products within chunks, the state passed on between them.

Dao and Gu 2024, Section 6. A task takes a head through a segment of chunks: its state and all that
passes between the products stay in a core's own cache. Nothing is stored between the passes but the
state before each segment.
"""

from asysplat.ops.ssd.cpu.scan import backward, forward, saved_state_shape

__all__ = ["backward", "forward", "saved_state_shape"]
