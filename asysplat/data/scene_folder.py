"""The scenes in a folder, of which only those in use are open."""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

from asysplat.data.bad_images import Policy
from asysplat.data.cache import ImageCache
from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.sequence import FileSequence

MOST_OPEN = 64


class SceneFolder(Sequence):
    """The scenes that a folder is or holds, each opened when first used.

    The MOST_OPEN last used stay open.

    Args:
        root: one scene, or a folder of scenes.
        height, width, layout, on_bad_image, cache, disparities: as `open_scene` takes them.

    Raises:
        InputError: no scene; and, when a scene is opened, files that cannot be used.
    """

    def __init__(
        self,
        root: str,
        height: int,
        width: int,
        layout: str = "auto",
        on_bad_image: Policy = "fail",
        cache: ImageCache | None = None,
        disparities: str | None = None,
    ):
        self.root = Path(root).absolute()
        self.layout, self.paths = find_scenes(root, layout)
        self._options = {
            "height": height,
            "width": width,
            "layout": self.layout,
            "on_bad_image": on_bad_image,
            "cache": cache,
            "disparities": disparities,
        }
        self._open: OrderedDict[int, FileSequence] = OrderedDict()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> FileSequence:
        if index not in self._open:
            self._open[index] = open_scene(self.paths[index], **self._options)
        self._open.move_to_end(index)
        while len(self._open) > MOST_OPEN:
            self._open.popitem(last=False)
        return self._open[index]

    def folders(self, index: int) -> set[str]:
        """Return the folder names between the root and a scene, and its own; it stays closed."""
        path = self.paths[index]
        return {*path.parts} - {*self.root.parts} | {path.name}
