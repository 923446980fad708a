"""The cameras of photographs: found by structure from motion, or refined."""

from asysplat.data.cameras.choose import CameraOptions, find_missing, refine_given
from asysplat.data.cameras.find import find_cameras
from asysplat.data.cameras.refine import refine_cameras

__all__ = ["CameraOptions", "find_cameras", "find_missing", "refine_cameras", "refine_given"]
