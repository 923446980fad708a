"""Posed images, synthetic or from files, as batches of training and evaluation tasks."""

from asysplat.root import import_later

LATER = {
    "Augmentation": "asysplat.data.augment",
    "FilesSource": "asysplat.data.sources",
    "ProceduralScene": "asysplat.data.procedural",
    "ProceduralSource": "asysplat.data.sources",
    "SceneDataModule": "asysplat.data.datamodule",
    "SceneOptions": "asysplat.data.sequence",
    "files_data": "asysplat.data.build",
    "find_scenes": "asysplat.data.readers",
    "open_scene": "asysplat.data.readers",
    "procedural_data": "asysplat.data.build",
}

__all__ = list(LATER)
__getattr__ = import_later(__name__, LATER)
