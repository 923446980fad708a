"""Render Gaussians to images: project, sort into tiles, rasterize."""

from asysplat.rendering.interface import (
    BLENDING_LIMITS,
    GSPLAT_1_5,
    INRIA,
    BlendingLimits,
    Projections,
)
from asysplat.rendering.render import Rendering, blending_weights, render

__all__ = [
    "BLENDING_LIMITS",
    "GSPLAT_1_5",
    "INRIA",
    "BlendingLimits",
    "Projections",
    "Rendering",
    "blending_weights",
    "render",
]
