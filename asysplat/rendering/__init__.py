"""Gaussians to images: project, sort into tiles, rasterize."""

from asysplat.rendering.interface import CONVENTIONS, GSPLAT_1_5, INRIA, Convention, Skips
from asysplat.rendering.render import Rendering, render

__all__ = ["CONVENTIONS", "GSPLAT_1_5", "INRIA", "Convention", "Rendering", "Skips", "render"]
