"""The cameras of photographs: found by structure from motion, or refined."""

from asysplat.data.cameras.find import find_cameras

__all__ = ["find_cameras"]
