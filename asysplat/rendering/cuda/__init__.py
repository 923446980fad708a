"""The renderer for GPUs: Triton kernels, compiled when first used.

A program draws a tile of 8 x 8 pixels with one warp. The gradient of every pair of splat and tile
has a place of its own and is summed in a fixed order: the same bits every time. Nothing here is
imported before `render` first draws with it, as Triton may be missing.
"""
