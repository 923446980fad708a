"""Posed photographs from made-up places and from files, as batches of reconstruction tasks."""

from asysplat.data.datamodule import SceneDataModule
from asysplat.data.modules import procedural_data, transforms_data
from asysplat.data.procedural import ProceduralScene
from asysplat.data.sources import ProceduralSource, TransformsSource
from asysplat.data.transforms import TransformsCapture

__all__ = [
    "ProceduralScene",
    "ProceduralSource",
    "SceneDataModule",
    "TransformsCapture",
    "TransformsSource",
    "procedural_data",
    "transforms_data",
]
