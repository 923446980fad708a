"""The renderer for CPUs: Numba kernels, compiled when first used and kept on disk.

A Gaussian is projected in float64 and rounded to a splat once; tiles of 16 x 16 pixels are drawn by
float32 vectors, a row at a time. Gradients are summed in a fixed order: the same bits on any number
of threads.
"""

from asysplat.rendering.cpu.draw import draw

__all__ = ["draw"]
