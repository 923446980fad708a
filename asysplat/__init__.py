"""Feed-forward 3D Gaussian splatting of long image sequences with asymmetric branches.

photographs = asysplat.open_photographs("my_scene", height=128, width=128, views=8)
gaussians = asysplat.predict(photographs.inputs, seconds=10.0)
asysplat.write_gaussians("scene.ply", photographs.normalization.to_world(gaussians))
"""

from asysplat.root import __version__, import_later

LATER = {
    "Cameras": "asysplat.scene",
    "Gaussians": "asysplat.scene",
    "Views": "asysplat.scene",
    "load": "asysplat.load",
    "open_photographs": "asysplat.data.photographs",
    "predict": "asysplat.refinement",
    "read_gaussians": "asysplat.export",
    "refine": "asysplat.refinement",
    "render": "asysplat.rendering",
    "write_gaussians": "asysplat.export",
}

__all__ = ["__version__", *LATER]
__getattr__ = import_later(__name__, LATER)
