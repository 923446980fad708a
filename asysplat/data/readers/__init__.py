"""Readers of posed photographs in the layouts in which they are published.

A layout is how a data set's files are arranged in its folder. Each has a reader, a module with two
functions:

find_scenes(root) -> list[Path]         the scenes of this layout that `root` is or holds
read_scene(scene, bad) -> PosedScene    one of them; frames that cannot be used are noted in `bad`

To add a data set whose layout is not here: write such a module (`llff` is a short one, `common` has
what readers share), add it to LAYOUTS, write conf/data/NAME.yaml and a section of data/README.md,
and let tests/data/readers/layouts/NAME.py write a scene to read. A data set whose layout is here
needs no code: see conf/data/mipnerf360.yaml.
"""

from pathlib import Path
from types import ModuleType

from asysplat.data.bad_images import BadFrames, Policy
from asysplat.data.cache import ImageCache
from asysplat.data.disparity import with_disparities
from asysplat.data.readers import (
    colmap,
    dl3dv,
    llff,
    long_lrm,
    posed,
    realestate10k,
    replica,
    scannetpp,
    transforms,
)
from asysplat.data.sequence import FileSequence
from asysplat.errors import InputError

# Where a folder fits several, the first of them reads it.
LAYOUTS: dict[str, ModuleType] = {
    "long_lrm": long_lrm,
    "realestate10k": realestate10k,
    "replica": replica,
    "scannetpp": scannetpp,
    "dl3dv": dl3dv,
    "transforms": transforms,
    "llff": llff,
    "posed": posed,
    "colmap": colmap,
}


def find_scenes(root: Path | str, layout: str = "auto") -> tuple[str, list[Path]]:
    """Return the layout of the scenes that `root` is or holds, and the scenes.

    Raises:
        InputError: an unknown layout, or no scene.
    """
    if layout not in ("auto", *LAYOUTS):
        raise InputError(f"data.layout={layout}: expected auto or one of {', '.join(LAYOUTS)}.")
    root = Path(root).absolute()
    for name in LAYOUTS if layout == "auto" else (layout,):
        scenes = LAYOUTS[name].find_scenes(root)
        if scenes:
            return name, scenes
    if not root.exists():
        raise InputError(f"{root} does not exist: name a scene, or a folder of scenes.")
    raise InputError(
        f"{root} holds no scene of layout {layout}: data/README.md shows which files "
        f"make one; the layouts are {', '.join(LAYOUTS)}."
    )


def open_scene(
    scene: Path | str,
    height: int,
    width: int,
    layout: str = "auto",
    on_bad_image: Policy = "fail",
    cache: ImageCache | None = None,
    disparities: Path | str | None = None,
) -> FileSequence:
    """Open one scene, its images unread.

    Args:
        scene: its folder, or a path that `find_scenes` returned.
        height, width: size of every view, in pixels.
        layout: a name in LAYOUTS, or auto.
        on_bad_image: "fail" raises an error that names every frame whose files cannot be used;
            "skip" leaves them out, with a warning, for which each image is decoded once.
        cache: where decoded pixels are kept.
        disparities: the folder of `python -m asysplat.data.disparity`; None reads none.

    Raises:
        InputError: files that cannot be used, or fewer than two frames.
    """
    path = Path(scene).absolute()
    if layout == "auto":
        layout, scenes = find_scenes(path)
        if len(scenes) != 1:
            raise InputError(f"{path} holds {len(scenes)} scenes: name one, such as {scenes[0]}.")
        path = scenes[0]
    bad = BadFrames(on_bad_image)
    posed = LAYOUTS[layout].read_scene(path, bad)
    if disparities is not None:
        posed = with_disparities(posed, path, Path(disparities))
    sequence = FileSequence(posed, height, width, cache)
    if on_bad_image == "skip":
        sequence = sequence.without_damaged(bad)
    bad.settle(str(path), sequence.num_frames)
    return sequence
