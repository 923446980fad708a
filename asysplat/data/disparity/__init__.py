"""Monocular disparities of images: estimated once, kept on disk, read when present.

python -m asysplat.data.disparity path/to/scenes
"""

from asysplat.data.disparity.maps import with_disparities

__all__ = ["with_disparities"]
