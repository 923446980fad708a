"""A scene as a mesh: its rendered depths, fused."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from asysplat.errors import InputError
from asysplat.export.formats.glb import to_linear
from asysplat.export.fusion import Mesh, fuse
from asysplat.files import atomic_write
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

MESHES = (".mesh.ply", ".mesh.glb")
MAX_PIXELS = 2**24  # of all views, above which these become smaller
UNLIT = "KHR_materials_unlit"  # glTF: colors already hold the scene's light


def mesh_suffix(path: str | Path) -> str | None:
    """Return which of MESHES a file has, also as its whole name: mesh.ply; None: it is no mesh."""
    return next((s for s in MESHES if f".{Path(path).name.lower()}".endswith(s)), None)


def check_mesh_packages(name: str) -> None:
    """Check that what a mesh needs is installed; `name` begins the message."""
    if not (find_spec("skimage") and find_spec("trimesh")):
        raise InputError(f"{name} needs scikit-image and trimesh: pip install 'asysplat[mesh]'.")


@torch.no_grad()
def write_mesh(
    path: str | Path, gaussians: Gaussians, cameras: Cameras, antialiased: bool = False
) -> Mesh:
    """Write the surfaces that one scene's cameras see, with the colors of their renderings.

    What an alpha below 1/2 shows is free space: an object is cut out. Axes are those of `write_ply`
    or `write_glb`, and a far scene's offset is left out.

    Args:
        path: the file, .mesh.ply or .mesh.glb.
        gaussians: [N].
        cameras: [V].
        antialiased: see `render`.

    Raises:
        InputError: scikit-image or trimesh is missing, no surface is seen, or the file cannot be
            written.
    """
    check_mesh_packages(str(path))
    shrink = max(1, cameras.num_views * cameras.height * cameras.width / MAX_PIXELS) ** 0.5
    size = (max(1, int(side / shrink)) for side in (cameras.height, cameras.width))
    cameras = cameras.to(gaussians.means).resized(*size)
    options = {"depth": "median", "antialiased": antialiased, "views_at_once": 1}
    drawn = render(gaussians, cameras, **options)
    # Divided by alpha, as there is no background on a surface.
    images = (drawn.image / drawn.alpha[:, None].clamp_min(0.5)).clamp(0, 1)
    # The transmittance of other pixels never falls to half.
    depths = drawn.depth.where(drawn.depth > 0, torch.inf)
    mesh = fuse(depths.cpu(), images.cpu(), cameras.to("cpu"))
    if len(mesh.faces) == 0:
        raise InputError(
            f"{path} is not written: in {cameras.num_views} views no alpha is above 1/2, expected "
            "surfaces; give a refined scene and its own cameras."
        )
    _save(Path(path), mesh)
    return mesh


def _save(path: Path, mesh: Mesh) -> None:
    import trimesh

    vertices, colors, options = mesh.vertices, mesh.colors, {}
    if path.suffix.lower() == ".glb":
        vertices, colors = vertices * vertices.new_tensor([-1, -1, 1]), to_linear(colors)
        options = {"tree_postprocessor": _make_unlit}
    levels = (255 * colors).round().byte().numpy()
    shape = trimesh.Trimesh(vertices, mesh.faces, vertex_colors=levels, process=False)
    with atomic_write(path) as partial:
        shape.export(partial, path.suffix[1:].lower(), **options)


def _make_unlit(tree: dict[str, Any]) -> None:
    tree["materials"] = [{"extensions": {UNLIT: {}}}]
    tree["extensionsUsed"] = [UNLIT]
    tree["meshes"][0]["primitives"][0]["material"] = 0
