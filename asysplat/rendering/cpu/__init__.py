"""Render on a CPU with Numba kernels, compiled at the first use and cached on disk.

Gaussians are projected in float64 and rounded to splats once; float32 vectors draw tiles of 16 x 16
pixels, a row at a time. Gradients are summed in a fixed order: any number of threads gives the same
bits.
"""

from asysplat.rendering.cpu.draw import draw

__all__ = ["draw"]
