"""Splats and tile lists to images: one module per backend, all with the same `rasterize`."""
