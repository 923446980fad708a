"""Files of Gaussians, camera paths, videos and the viewer."""

from asysplat.later import import_later

LATER = {
    "orbit": "asysplat.export.camera_paths",
    "read_gaussians": "asysplat.export.gaussians",
    "read_ply": "asysplat.export.ply",
    "read_safetensors": "asysplat.export.tensors",
    "read_splat": "asysplat.export.splat",
    "smoothed_path": "asysplat.export.camera_paths",
    "write_gaussians": "asysplat.export.gaussians",
    "write_ply": "asysplat.export.ply",
    "write_safetensors": "asysplat.export.tensors",
    "write_video": "asysplat.export.video",
}

__all__ = list(LATER)
__getattr__ = import_later(__name__, LATER)
