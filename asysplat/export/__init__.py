"""Files of Gaussians, camera paths, videos and the viewer."""

from asysplat.root import import_later

LATER = {
    "Notes": "asysplat.export.gaussians",
    "orbit": "asysplat.export.camera_paths",
    "read_gaussians": "asysplat.export.gaussians",
    "read_notes": "asysplat.export.gaussians",
    "read_ply": "asysplat.export.formats.ply",
    "read_safetensors": "asysplat.export.formats.safetensors",
    "read_splat": "asysplat.export.formats.splat",
    "smoothed_path": "asysplat.export.camera_paths",
    "write_gaussians": "asysplat.export.gaussians",
    "write_page": "asysplat.export.page",
    "write_ply": "asysplat.export.formats.ply",
    "write_safetensors": "asysplat.export.formats.safetensors",
    "write_video": "asysplat.export.video",
}

__all__ = list(LATER)
__getattr__ = import_later(__name__, LATER)
