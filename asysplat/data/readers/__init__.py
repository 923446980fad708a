"""Readers of the public layouts of posed photographs, each straight from its own files.

A layout is a module with two functions:

find_scenes(root) -> the scenes of this layout that `root` is or holds
read_scene(scene, bad) -> PosedScene of one of them; what is wrong with single frames goes to `bad`
"""

from pathlib import Path
from types import ModuleType

from asysplat.data.bad_frames import BadFrames, Policy
from asysplat.data.cache import ImageCache
from asysplat.data.photographs import PhotographCapture
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
from asysplat.errors import InputError

# Where a folder has several, the first counts.
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
    """The layout of the scenes that `root` is or holds, and the scenes.

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
    on_bad_frame: Policy = "fail",
    cache: ImageCache | None = None,
) -> PhotographCapture:
    """One scene, its images unread.

    Args:
        scene: its folder, or as `find_scenes` names it.
        height, width: of every view, in pixels.
        layout: a name in LAYOUTS, or auto.
        on_bad_frame: "fail" names every frame whose files cannot be used; "skip" leaves them out,
            with a warning, and decodes each image once to know.
        cache: of what was decoded.

    Raises:
        InputError: files that cannot be used, or fewer than two frames.
    """
    path = Path(scene).absolute()
    if layout == "auto":
        layout, scenes = find_scenes(path)
        if len(scenes) != 1:
            raise InputError(f"{path} holds {len(scenes)} scenes: name one, such as {scenes[0]}.")
        path = scenes[0]
    bad = BadFrames(on_bad_frame)
    posed = LAYOUTS[layout].read_scene(path, bad)
    capture = PhotographCapture(posed, height, width, cache)
    if on_bad_frame == "skip":
        capture = capture.without_damaged(bad)
    bad.settle(str(path), capture.num_frames)
    return capture
