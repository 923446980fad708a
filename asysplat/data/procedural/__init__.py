"""Synthetic scenes, the data set that needs no download."""

from asysplat.data.procedural.scene import ProceduralScene, split_seed

__all__ = ["ProceduralScene", "split_seed"]
