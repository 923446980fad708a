"""Posed images, synthetic or from files, as batches of training and evaluation tasks."""

from asysplat.data.augment import Augmentation
from asysplat.data.build import files_data, procedural_data
from asysplat.data.cache import ImageCache
from asysplat.data.datamodule import SceneDataModule
from asysplat.data.procedural import ProceduralScene
from asysplat.data.readers import find_scenes, open_scene
from asysplat.data.sequence import SceneOptions
from asysplat.data.sources import FilesSource, ProceduralSource

__all__ = [
    "Augmentation",
    "FilesSource",
    "ImageCache",
    "ProceduralScene",
    "ProceduralSource",
    "SceneDataModule",
    "SceneOptions",
    "files_data",
    "find_scenes",
    "open_scene",
    "procedural_data",
]
