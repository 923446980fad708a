"""The renderer in plain torch: on any device, in any float type, a step at a time."""

from asysplat.rendering.reference.draw import draw

__all__ = ["draw"]
