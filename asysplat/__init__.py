"""Feed-forward 3D Gaussian splatting of long image sequences with asymmetric branches.

photographs = asysplat.open_photographs("my_scene", height=128, width=128, views=8)
gaussians = asysplat.load("shipped")(photographs.inputs)
gaussians = asysplat.refine(gaussians, photographs.inputs, seconds=10.0)
asysplat.write_gaussians("scene.ply", photographs.frame.to_world(gaussians))
"""

from importlib import import_module

# Imported when first used, since torch takes seconds.
LATER = {
    "Cameras": "asysplat.scene",
    "Gaussians": "asysplat.scene",
    "Views": "asysplat.scene",
    "load": "asysplat.load",
    "mean_color": "asysplat.refinement",
    "open_photographs": "asysplat.refinement.photographs",
    "read_gaussians": "asysplat.export",
    "refine": "asysplat.refinement",
    "render": "asysplat.rendering",
    "write_gaussians": "asysplat.export",
}

__all__ = list(LATER)


def __getattr__(name: str) -> object:
    """Import what LATER names."""
    if name not in LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # Stored, since the import of asysplat.load leaves the module under the name of its function.
    globals()[name] = getattr(import_module(LATER[name]), name)
    return globals()[name]
