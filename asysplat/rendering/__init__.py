"""Gaussians to images: project, sort into tiles, rasterize."""

from asysplat.rendering.render import Rendering, render

__all__ = ["Rendering", "render"]
