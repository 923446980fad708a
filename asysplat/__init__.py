"""Feed-forward 3D Gaussian splatting of long image sequences with asymmetric branches.

The paper's symbols, as the code names and shapes them:

    V            number of input views           views, [..., V, 3, H, W]
    H, W         image height and width          height, width
    p_c, p_f     coarse and fine patch size      patch_coarse, patch_fine (16, 8)
    d_c, d_s     width of the coarse tokens      stage_widths (192, 512, 896), one a network
                                                 stage; d_c is the first
    d_f          width of the fine tokens        fine_width (256)
    N_b, N_a     Mamba, attention layers         layers ("4m4s"), in each network stage
    N_v          MambaVision layers              appearance_layers (2), in each network stage
    p_g          side of the attention grid      grid (2)
    r_s          MLP ratio                       stage_ratios (1, 2, 3), one a network stage
    C, F         coarse, fine tokens             coarse, fine, [B, V, h, w, d]
    N            number of Gaussians             V H W (p_f / p_c)^2
    z            numbers that make a Gaussian    59 = 3 position + 4 quaternion + 3 scale
                                                      + 1 opacity + 48 spherical harmonics
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
