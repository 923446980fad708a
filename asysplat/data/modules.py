"""What `conf/data` names: a source and the data module that draws from it."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from asysplat.data.bad_frames import Policy
from asysplat.data.cache import ImageCache
from asysplat.data.datamodule import SceneDataModule
from asysplat.data.sources import FilesSource, ProceduralSource, Source, Task
from asysplat.errors import InputError


def procedural_data(
    height: int,
    width: int,
    num_frames: int,
    window: Sequence[int],
    val_scenes: int,
    test_scenes: int,
    places: str,
    **options,
) -> SceneDataModule:
    """Made-up scenes; arguments are those of ProceduralSource and `scene_data`."""

    def source(num_frames: int, test_scenes: int, places: str) -> ProceduralSource:
        return ProceduralSource(height, width, num_frames, window, val_scenes, test_scenes, places)

    own = {"num_frames": num_frames, "test_scenes": test_scenes, "places": places}
    return scene_data(source(**own), source, own, height=height, width=width, **options)


def files_data(
    root: str,
    height: int,
    width: int,
    window: Sequence[int],
    layout: str = "auto",
    on_bad_frame: Policy = "fail",
    cache: ImageCache | None = None,
    test_root: str | None = None,
    selection: str = "every_8th",
    index: str | None = None,
    val_scenes: int = 8,
    targets_may_be_inputs: bool = False,
    **options,
) -> SceneDataModule:
    """Scenes on disk; arguments are those of FilesSource and `scene_data`.

    A further test set may differ in the root of what it tests, layout, selection and index.
    """

    def source(root: str, **others) -> FilesSource:
        reading = {"on_bad_frame": on_bad_frame, "cache": cache, **others}
        return FilesSource(root, height, width, window, **reading)

    own = {"layout": layout, "selection": selection, "index": index}
    main = source(
        root,
        test_root=test_root,
        val_scenes=val_scenes,
        targets_may_be_inputs=targets_may_be_inputs,
        **own,
    )
    own["root"] = test_root or root
    return scene_data(main, source, own, height=height, width=width, **options)


def scene_data(
    source: Source,
    make_source: Callable[..., Source],
    own: dict[str, Any],
    name: str,
    inputs: int,
    targets: int,
    test_sets: Mapping[str, Any] | None = None,
    **options,
) -> SceneDataModule:
    """A data module that is tested on further sets as well.

    Args:
        source: of the data set itself.
        make_source: of a test set, from the options `own`, in which test sets may differ.
        test_sets: name -> the options that differ: any of `own`, inputs and targets.
        name, inputs, targets, options: those of SceneDataModule.

    Raises:
        InputError: a test set that is called as the data set, or with an unknown option.
    """
    main = {"inputs": inputs, "targets": targets, **own}
    sets = {}
    for other, changes in (test_sets or {}).items():
        _check_test_set(other, changes, name, main)
        sets[other] = partial(_test_tasks, make_source, **{**main, **changes})
    return SceneDataModule(
        name=name,
        source=source,
        inputs=inputs,
        targets=targets,
        test_sets=sets,
        **options,
    )


def _test_tasks(
    make_source: Callable[..., Source], inputs: int, targets: int, **own: Any
) -> list[Task]:
    return make_source(**own).evaluation("test", inputs, targets)


def _check_test_set(other: str, changes: Any, name: str, main: Mapping[str, Any]) -> None:
    if other == name:
        raise InputError(
            f"data.test_sets.{other} has the name of the data set itself: call it otherwise."
        )
    if not isinstance(changes, Mapping):
        raise InputError(
            f"data.test_sets.{other} is {changes!r}: give the options that differ, such as "
            f"data.test_sets.{other}.inputs=16."
        )
    for option in changes:
        if option not in main:
            raise InputError(
                f"data.test_sets.{other}.{option} is no option of a test set: "
                f"give any of {', '.join(main)}."
            )
