"""Photographs in memory: scenes synthetic here, and real ones where they are."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch.nn.functional as F

from asysplat.benchmark.options import check_names
from asysplat.data.normalize import normalize
from asysplat.data.procedural import ProceduralScene
from asysplat.data.procedural.scene import split_seed
from asysplat.data.selection import spread, uniform_selection
from asysplat.errors import InputError
from asysplat.refinement.photographs import open_photographs
from asysplat.scene import Views

INPUTS, TARGETS = 16, 4  # most views of a scene to start from, and to draw
FRAMES = 96  # of a scene that is synthetic
MADE_UP = {"room": "rooms", "outdoors": "outdoors"}  # test scenes, by what they show
REAL = ("fern", "fox", "hololens-000", "mydesk")  # folders of data/; others may be there, too
HELD_OUT_EVERY = 8  # one photograph in so many is drawn


@dataclass(frozen=True)
class PosedScene:
    """What a reconstruction starts from, and what it is measured on.

    Args:
        name: of the scene.
        inputs: photographs in memory, [V], in the frame of the files.
        targets: views to draw, [V'], in the same frame.
    """

    name: str
    inputs: Views
    targets: Views

    def given(self, views: int, side: int) -> tuple[Views, Views]:
        """Return `views` of the inputs, evenly, of side x side pixels, and the targets.

        Both are in the network's frame. A scene with fewer views gives all of them.

        Raises:
            InputError: more pixels than the photographs have.
        """
        cameras = self.inputs.cameras
        if side > cameras.height:
            raise InputError(
                f"pareto has a setting with side={side}: give at most pareto.side={cameras.height}."
            )
        chosen = spread(range(cameras.num_views), min(views, cameras.num_views))
        inputs = self.inputs.select(chosen)
        if side != cameras.height:
            images = F.interpolate(inputs.images, (side, side), mode="area")
            inputs = Views(inputs.cameras.resized(side, side), images)
        return normalize(inputs, self.targets)[:2]


def find_scenes(
    names: Sequence[str], folder: Path, side: int
) -> tuple[dict[str, Callable[[], PosedScene]], dict[str, str]]:
    """Return what opens each scene, and why others are not measured.

    Args:
        names: of MADE_UP, REAL, or folders in `folder`.
        folder: holds scenes of photographs.
        side: pixels of the photographs, which are square.

    Raises:
        InputError: a name that no scene has, or none is there.
    """
    there = (
        sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    )
    check_names("pareto.scenes", names, dict.fromkeys([*MADE_UP, *REAL, *there]))
    found, absent = {}, {}
    for name in names:
        if name in MADE_UP:
            found[name] = partial(_make_up, name, side)
        elif name in there:
            found[name] = partial(_read, name, folder / name, side)
        else:
            absent[name] = f"{folder / name} is no folder"
    if not found:
        raise InputError(
            f"pareto.scenes={list(names)}: none is a folder of {folder}; set ASYSPLAT_SHARED to "
            f"the folder that holds data/, or take of {', '.join(MADE_UP)}."
        )
    return found, absent


def _make_up(name: str, side: int) -> PosedScene:
    scene = ProceduralScene(split_seed("test", 0), side, side, FRAMES, places=MADE_UP[name])
    frames = uniform_selection(FRAMES, INPUTS, TARGETS)
    return PosedScene(name, _plain(scene.views(frames.inputs)), _plain(scene.views(frames.targets)))


def _read(name: str, path: Path, side: int) -> PosedScene:
    found = open_photographs(
        path,
        side,
        side,
        views=INPUTS,
        held_out=HELD_OUT_EVERY,
        max_held_out=TARGETS,
        say=lambda _: None,  # that cameras fit cannot be told at so few pixels
    )
    return PosedScene(name, _plain(found.inputs), _plain(found.measured))


def _plain(views: Views) -> Views:
    """Leave depths and masks out: photographs and cameras are all that is given."""
    return replace(views, depths=None, masks=None, point_depths=None)
