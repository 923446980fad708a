"""Render on a GPU with Triton kernels, compiled at the first use.

A program draws a tile of 8 x 8 pixels with one warp. Every pair of splat and tile has its own
gradient, and these are summed in a fixed order: every run gives the same bits. `render` imports
this package at its first use, because Triton may be missing.
"""
