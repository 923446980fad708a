"""Read the protocols of conf/public, find their scenes, and open them as they say."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from hydra.utils import instantiate
from omegaconf import OmegaConf
from pydantic.dataclasses import dataclass

from asysplat.data.background import Background
from asysplat.data.images import same_proportions
from asysplat.data.photographs import Photographs, load_photographs
from asysplat.data.readers import LAYOUTS, open_scene
from asysplat.data.resized import as_published
from asysplat.data.sequence import PosedScene, SceneOptions
from asysplat.errors import InputError
from asysplat.evaluation.protocol import Protocol
from asysplat.files import check_exists
from asysplat.ranges import AtLeastTwo, Count, configured
from asysplat.root import CONF
from asysplat.scene import Views

PIXEL = 1  # a side at which no pixels are read


@dataclass(frozen=True, config=configured("conf/public"))
class SceneProtocol:
    """How numbers on some scenes are published: images, size, split, background and metrics.

    Args:
        scenes: number of images, height and width of each, by name.
        views: number of input views, evenly over all that are not held out; "all": all of them.
        position: the whole number of a view's position among them: the "nearest", even if two are
            equally near, or the next one "below".
        indices: these images in place of even ones; the first `views` of them are the input views.
        held_out_every: every so many images are held out, from the first on: of those that the
            data set names, else of all but `indices`, in the order of their names.
        excluded: images that are in neither part.
        masked: held-out images are measured on white, where their masks have the object; input
            images keep what is behind it.
        metrics: a file of conf/metrics.
    """

    name: str
    title: str
    layout: str
    scenes: dict[str, tuple[int, int, int]]
    metrics: str
    views: AtLeastTwo | Literal["all"] = "all"
    position: Literal["nearest", "below"] = "nearest"
    indices: tuple[int, ...] | None = None
    held_out_every: Count = 8
    excluded: tuple[int, ...] = ()
    masked: bool = False
    background: Background = "mean"

    def inputs(self, rest: list[int]) -> list[int]:
        """Select the input views from the indices of the images that are not held out."""
        if self.indices is not None:
            return list(self.indices[: self.views])
        if self.views == "all":
            return rest
        positions = np.linspace(0, len(rest) - 1, self.views)
        whole = positions.round() if self.position == "nearest" else positions
        return [rest[int(position)] for position in whole]

    def held_out(self, named: list[int]) -> list[int]:
        """Select the held-out images from those that the data set names, or from all."""
        never = {*self.excluded, *(self.indices or ())}
        return [index for index in named[:: self.held_out_every] if index not in never]

    def read_metrics(self) -> Protocol:
        """Build the metrics."""
        return instantiate(OmegaConf.load(CONF / "metrics" / f"{self.metrics}.yaml"))

    def describe(self) -> dict[str, Any]:
        """Return all that numbers depend on but what fits the scenes."""
        return asdict(self) | {"metrics": self.read_metrics().describe()}


def read_protocols() -> dict[str, SceneProtocol]:
    """Read all protocols, by name; a file with several numbers of `views` has several."""
    protocols = {}
    for file in sorted((CONF / "public").glob("*.yaml")):
        fields: Any = OmegaConf.to_container(OmegaConf.load(file))
        name, title = fields.pop("name", file.stem), fields.pop("title")
        for views in fields.pop("views", ["all"]):
            names = (name, title)
            if views != "all":
                names = f"{name}_{views}_views", f"{title}, {views} views"
            protocols[names[0]] = SceneProtocol(*names, views=views, **fields)
    return protocols


def find_folders(
    root: Path, protocols: list[SceneProtocol]
) -> list[tuple[SceneProtocol, str, Path]]:
    """Find the scenes of protocols below a folder, by layout and by the folder's name."""
    check_exists(root, "a folder of published scenes")
    layouts = {protocol.layout for protocol in protocols}
    folders = {layout: LAYOUTS[layout].find_scenes(root) for layout in layouts}
    found = [
        (protocol, folder.name, folder)
        for protocol in protocols
        for folder in folders[protocol.layout]
        if folder.name in protocol.scenes
    ]
    if not found:
        names = dict.fromkeys(name for protocol in protocols for name in protocol.scenes)
        raise InputError(
            f"data.root={root} has no published scene: name a folder that holds some, in folders "
            f"of their names: {', '.join(names)}."
        )
    return found


def open_published(
    protocol: SceneProtocol, folder: Path, say: Callable[[str], None]
) -> tuple[Photographs, str]:
    """Open a scene as a protocol says; return which images were read, too.

    Raises:
        InputError: another number of images, or images that are smaller or of other proportions.
    """
    count, height, width = protocol.scenes[folder.name]
    scene = open_scene(folder, SceneOptions(PIXEL, PIXEL, protocol.layout)).scene
    if len(scene.images) != count:
        raise InputError(
            f"{folder} has {len(scene.images)} images, and {protocol.title} has {count} of this "
            "scene: get the whole scene, its test images too."
        )
    scene, copies = as_published(scene, height, width)
    lens = scene.images[0].lens
    if lens.height < height or not same_proportions((width, height), (lens.width, lens.height)):
        raise InputError(
            f"{folder} has images of {lens.height}x{lens.width} (height x width), and "
            f"{protocol.title} is measured at {height}x{width}: get the scene at that size."
        )
    images = copies or ("as they are" if lens.height == height else "resized here, Lanczos")
    held_out = protocol.held_out(scene.held_out or list(range(count)))
    rest = sorted(set(range(count)) - {*scene.held_out, *held_out})
    inputs = protocol.inputs(rest)
    if protocol.masked:
        scene = _with_masks_of(scene, held_out)
    photographs = load_photographs(
        scene, inputs, held_out, height, width, protocol.background, say=say
    )
    if protocol.masked and photographs.held_out is not None:
        photographs = replace(photographs, held_out=_on_white(photographs.held_out))
    return photographs, images


def _with_masks_of(scene: PosedScene, held_out: list[int]) -> PosedScene:
    """Keep the masks of held-out images alone, as what is measured; raise InputError without."""
    images = [replace(image, mask=None, is_object=False) for image in scene.images]
    for index in held_out:
        if (mask := scene.images[index].mask) is None:
            raise InputError(
                f"{scene.images[index].file} has no mask, and it is measured where its mask has "
                "the object: get the masks of the scene, too."
            )
        images[index] = replace(images[index], mask=mask)
    return replace(scene, images=images)


def _on_white(views: Views) -> Views:
    return replace(views, images=views.images.where(views.masks[:, None], 1.0))
