"""Gaussians to images: project, sort into tiles, rasterize."""

from asysplat.rendering.convention import CONVENTIONS, GSPLAT_1_5, INRIA, Convention
from asysplat.rendering.render import Rendering, render
from asysplat.rendering.settings import Skips

__all__ = ["CONVENTIONS", "GSPLAT_1_5", "INRIA", "Convention", "Rendering", "Skips", "render"]
