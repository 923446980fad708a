"""Feed-forward 3D Gaussian splatting of long image sequences with asymmetric branches.

photographs = asysplat.open_photographs("my_scene", height=128, width=128, views=8)
gaussians = asysplat.load("shipped")(photographs.inputs)
gaussians = asysplat.refine(gaussians, photographs.inputs, seconds=10.0)
asysplat.write_gaussians("scene.ply", photographs.frame.to_world(gaussians))
"""

from importlib import import_module

from asysplat.export import read_gaussians, write_gaussians
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views

# Imported when first asked for: they bring Hydra, image readers and plots along.
LATER = {
    "load": "asysplat.load",
    "mean_color": "asysplat.refinement",
    "open_photographs": "asysplat.refinement.photographs",
    "refine": "asysplat.refinement",
}

__all__ = [
    "Cameras",
    "Gaussians",
    "Views",
    "load",
    "mean_color",
    "open_photographs",
    "read_gaussians",
    "refine",
    "render",
    "write_gaussians",
]


def __getattr__(name: str) -> object:
    """Import what LATER names."""
    if name not in LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # Stored, since the import of asysplat.load leaves the module under the name of its function.
    globals()[name] = getattr(import_module(LATER[name]), name)
    return globals()[name]
