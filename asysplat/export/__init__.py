"""Files of Gaussians, camera paths, videos and the viewer."""

from asysplat.export.camera_paths import orbit, smoothed_path
from asysplat.export.gaussians import read_gaussians, write_gaussians
from asysplat.export.ply import read_ply, write_ply
from asysplat.export.splat import read_splat
from asysplat.export.tensors import read_safetensors, write_safetensors
from asysplat.export.video import write_video

__all__ = [
    "orbit",
    "read_gaussians",
    "read_ply",
    "read_safetensors",
    "read_splat",
    "smoothed_path",
    "write_gaussians",
    "write_ply",
    "write_safetensors",
    "write_video",
]
