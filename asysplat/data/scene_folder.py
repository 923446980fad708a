"""The scenes in a folder; only those in use are open."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.sequence import FileSequence, SceneOptions

MAX_OPEN = 64


class SceneFolder(Sequence):
    """The scenes that a folder is or holds, each opened at its first use.

    The MAX_OPEN last used stay open.

    Args:
        root: one scene, or a folder of scenes.

    Raises:
        InputError: no scene; and, when a scene is opened, files that cannot be used.
    """

    def __init__(self, root: str, options: SceneOptions):
        self.root = Path(root).absolute()
        layout, self.paths = find_scenes(root, options.layout)
        self._options = replace(options, layout=layout)
        self._open: OrderedDict[int, FileSequence] = OrderedDict()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> FileSequence:
        if index not in self._open:
            self._open[index] = open_scene(self.paths[index], self._options)
        self._open.move_to_end(index)
        while len(self._open) > MAX_OPEN:
            self._open.popitem(last=False)
        return self._open[index]

    def folders(self, index: int) -> set[str]:
        """Return the folder names between the root and a scene, and its own, without opening it."""
        path = self.paths[index]
        return {*path.parts} - {*self.root.parts} | {path.name}
