"""What `conf/data` names: a source and the data module that draws from it."""

from collections.abc import Sequence

from asysplat.data.datamodule import SceneDataModule
from asysplat.data.sources import ProceduralSource, TransformsSource


def procedural_data(
    height: int,
    width: int,
    num_frames: int,
    window: Sequence[int],
    val_scenes: int,
    test_scenes: int,
    **options,
) -> SceneDataModule:
    """Made-up scenes; arguments are those of ProceduralSource and SceneDataModule."""
    source = ProceduralSource(height, width, num_frames, window, val_scenes, test_scenes)
    return SceneDataModule(source=source, height=height, width=width, **options)


def transforms_data(
    root: str, height: int, width: int, window: Sequence[int], **options
) -> SceneDataModule:
    """Scenes with a `transforms.json`; arguments are those of TransformsSource and
    SceneDataModule."""
    source = TransformsSource(root, height, width, window)
    return SceneDataModule(source=source, height=height, width=width, **options)
