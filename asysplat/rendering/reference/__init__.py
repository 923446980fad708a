"""Render in plain torch, on any device and in any float type."""

from asysplat.rendering.reference.draw import draw

__all__ = ["draw"]
