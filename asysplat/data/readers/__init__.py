"""Readers of posed photographs, one for each layout in which they are published.

A layout is the arrangement of a data set's files in its folder. Its reader is a module with two
functions:

find_scenes(root) -> list[Path]         the scenes of this layout that `root` is or holds
read_scene(scene, bad) -> PosedScene    one of them; errors of single images are collected in `bad`,
                                        and an InputError is raised for a scene that is not usable

To add a layout: write such a module (`llff` is a short one, `common` has shared functions), add it
to READERS, write conf/data/NAME.yaml and a section of data/README.md, and add a writer of it in
tests/data/readers/layouts/NAME.py. A data set in a known layout needs no code: see
conf/data/mipnerf360.yaml.
"""

from pathlib import Path
from types import ModuleType

from asysplat.data import frames
from asysplat.data.bad_images import BadImages
from asysplat.data.readers import (
    blender,
    colmap,
    dl3dv,
    idr,
    llff,
    long_lrm,
    middlebury,
    posed,
    posediffusion,
    prepared,
    realestate10k,
    replica,
    scannetpp,
    scannetpp_depths,
    transforms,
)
from asysplat.data.readers.additions import with_faces, with_masks
from asysplat.data.readers.common import SUFFIXES, file_errors, images_in, natural_order
from asysplat.data.sequence import FileSequence, MasksOf, PosedScene, SceneOptions
from asysplat.errors import InputError
from asysplat.files import check_exists

# In this order: the first layout that fits a folder reads it.
READERS = (
    *(prepared, long_lrm, realestate10k, replica, scannetpp, dl3dv, transforms, blender, llff),
    *(posed, idr, middlebury, posediffusion, colmap, scannetpp_depths),
)
LAYOUTS: dict[str, ModuleType] = {reader.__name__.rpartition(".")[2]: reader for reader in READERS}


def find_scenes(root: Path | str, layout: str = "auto") -> tuple[str, list[Path]]:
    """Return the layout of the scenes that `root` is or holds, and the scenes.

    Scenes of any layout may have been prepared.
    """
    _check_layout(layout)
    root = Path(root).absolute()
    for name in LAYOUTS if layout == "auto" else ("prepared", layout):
        with file_errors(root):
            scenes = LAYOUTS[name].find_scenes(root)
        if scenes:
            return name, scenes
    check_exists(root, "a scene, or a folder of scenes")
    if root.is_file() and root.suffix.lower() in SUFFIXES:
        raise InputError(f"{root} is one photograph: name the folder of all.")
    if layout == "auto" and (bare := _bare(root)):
        raise InputError(
            f"{root} has {bare} without camera poses: find them first, with python -m "
            f"asysplat.data.cameras {root}, and name the folder that it prints."
        )
    raise InputError(
        f"{root} holds no photographs with camera poses, in layout {layout}: data/README.md "
        f"lists the files of each layout; the layouts are {', '.join(LAYOUTS)}."
    )


def _check_layout(layout: str) -> None:
    if layout not in ("auto", *LAYOUTS):
        raise InputError(f"layout={layout}: expected auto or one of {', '.join(LAYOUTS)}.")


def without_cameras(root: Path | str) -> str | None:
    """Describe photographs or a video without camera poses; None where nothing is, or poses are."""
    root = Path(root).absolute()
    with file_errors(root):
        posed = any(reader.find_scenes(root) for reader in READERS)
    return None if posed else _bare(root)


def _bare(root: Path) -> str | None:
    if root.is_file():
        return "a video" if root.suffix.lower() in frames.SUFFIXES else None
    count = len(photographs_in(root))
    return f"{count} photographs" if count else None


def photographs_in(root: Path) -> list[Path]:
    """List the image files of a folder, or of its images/, 2 before 10."""
    return sorted(images_in(root) or images_in(root / "images"), key=natural_order)


def read_scene(
    layout: str,
    scene: Path,
    bad: BadImages,
    masks: MasksOf = "auto",
    size: tuple[int, int] | None = None,
) -> PosedScene:
    """Read one of the `find_scenes` with its images' masks, and panoramas as their faces.

    Errors of single images are collected. `size`, height and width, chooses a prepared file.
    """
    with file_errors(scene):
        if layout == "prepared":  # its masks and faces are known
            return prepared.read_scene(scene, bad, size)
        return with_faces(with_masks(LAYOUTS[layout].read_scene(scene, bad), bad, masks), bad)


def open_scene(scene: Path | str, options: SceneOptions) -> FileSequence:
    """Open one scene without reading pixels."""
    path, layout = Path(scene).absolute(), options.layout
    _check_layout(layout)
    if layout == "auto":
        layout, scenes = find_scenes(path)
        if len(scenes) != 1:
            raise InputError(f"{path} holds {len(scenes)} scenes: name one, such as {scenes[0]}.")
        path = scenes[0]
    bad = BadImages(options.on_error)
    posed = read_scene(layout, path, bad, options.masks, (options.height, options.width))
    sequence = FileSequence(posed, options)
    if options.on_error == "skip":
        sequence = sequence.without_damaged(bad)
    bad.report(str(path), sequence.num_images)
    return sequence
