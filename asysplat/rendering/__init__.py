"""Render Gaussians to images: project, sort into tiles, rasterize."""

from asysplat.rendering.interface import CONVENTIONS, GSPLAT_1_5, INRIA, Convention, Culling
from asysplat.rendering.render import Rendering, render

__all__ = ["CONVENTIONS", "GSPLAT_1_5", "INRIA", "Convention", "Culling", "Rendering", "render"]
