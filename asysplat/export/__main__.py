"""A scene in another format, smaller on request.

asysplat export scene.ply scene.spz
"""

from argparse import ArgumentParser
from pathlib import Path

from asysplat.cli import exit_with_message
from asysplat.files import check_exists

if __name__ == "__main__":  # now, since torch takes seconds
    parser = ArgumentParser("asysplat export", description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path, help="a file of Gaussians")
    parser.add_argument(
        "output",
        type=Path,
        help="the new file: .ply, .compressed.ply, .spz, .sog, .glb, .splat, .safetensors, .html; "
        "or a mesh of the surfaces: mesh.ply, mesh.glb, or what ends in .mesh.ply or .mesh.glb",
    )
    parser.add_argument(
        "--keep", type=float, default=1.0, metavar="F", help="keep this fraction, by importance"
    )
    parser.add_argument("--sh", type=int, choices=range(4), help="highest degree of SH to keep")
    arguments = parser.parse_args()
    with exit_with_message("stopped."):
        check_exists(arguments.scene, "a file of Gaussians")

from dataclasses import replace

from asysplat.errors import InputError
from asysplat.export.gaussians import (
    CAMERAS,
    READERS,
    WRITERS,
    cameras_beside,
    names_beside,
    read_gaussians,
    read_notes,
    suffix_of,
    write_gaussians,
)
from asysplat.export.importance import most_important, picture_psnr
from asysplat.export.mesh import MESHES, check_mesh_packages, mesh_suffix, write_mesh
from asysplat.export.page import PAGE, write_page
from asysplat.interrupts import handle_signals


def export(scene: Path, output: Path, keep: float = 1.0, sh_degree: int | None = None) -> None:
    """Write a scene to another file, and print what it took: bytes, Gaussians and likeness.

    Args:
        scene: a file of Gaussians; the cameras beside it, transforms.json, tell what is important,
            and a mesh needs them.
        output: the new file.
        keep: fraction of the Gaussians, by importance, in (0, 1].
        sh_degree: highest degree of SH; None: the scene's.
    """
    suffix = mesh_suffix(output) or suffix_of(output, [*WRITERS, *MESHES], "written")
    if suffix in MESHES:
        check_mesh_packages(str(output))
    if not 0 < keep <= 1:
        raise InputError(f"--keep is {keep:g}: give a fraction above 0, at most 1.")
    if output.exists():
        raise InputError(f"{output} exists: remove it, or name another file.")
    gaussians, notes = read_gaussians(scene), read_notes(scene)
    cameras = cameras_beside(scene, gaussians)
    written = gaussians
    if keep < 1:
        pictures = 0 if cameras is None else cameras.num_views
        print(f"weighing {written.num_gaussians:,} Gaussians in {pictures} pictures")
        written = written.keep(most_important(written, keep, cameras))
    if sh_degree is not None:
        written = replace(written, sh=written.sh[:, : (sh_degree + 1) ** 2])
    content = f"{written.num_gaussians:,} Gaussians"
    if suffix in MESHES:
        if cameras is None:
            raise InputError(
                f"{scene} has no {CAMERAS} of its cameras beside it, which {output.name} needs: "
                "give the scene.ply of a reconstruction."
            )
        content = (
            f"{len(write_mesh(output, written, cameras, notes.antialiased).faces):,} triangles"
        )
    elif cameras is not None and suffix == PAGE:
        write_page(output, written, cameras, names_beside(scene), **notes.look)
    else:
        write_gaussians(output, written, notes)
    print(f"{output}: {content}, {output.stat().st_size / 1e6:.2f} MB")
    if any(notes.offset) and read_notes(output).offset != notes.offset:
        print(f"{output.suffix} has no place for the offset {' '.join(map(repr, notes.offset))}")
    if cameras is not None and output.suffix.lower() in READERS and suffix not in MESHES:
        likeness = picture_psnr(gaussians, read_gaussians(output), cameras, **notes.look)
        print(f"{likeness:.1f} dB against the pictures of {scene}")


if __name__ == "__main__":
    handle_signals()
    with exit_with_message("stopped."):
        export(arguments.scene, arguments.output, arguments.keep, arguments.sh)
