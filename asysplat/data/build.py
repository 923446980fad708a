"""Build what `conf/data` names: a source of tasks, and the data module that draws from it."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from asysplat.data.bad_images import Policy
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
    varied: bool = False,
    test_sets: Mapping[str, Any] | None = None,
    **options,
) -> SceneDataModule:
    """Build a data module of synthetic scenes.

    The arguments are those of ProceduralSource and `scene_data`.
    """

    make_source = partial(ProceduralSource, window=window, val_scenes=val_scenes, varied=varied)
    changeable = {
        "height": height,
        "width": width,
        "num_frames": num_frames,
        "test_scenes": test_scenes,
        "places": places,
    }
    tested = tested_sets(test_sets, options["name"], on_disk=False)
    source = make_source(**changeable)
    return scene_data(source, make_source, changeable, test_sets=tested, **options)


def files_data(
    root: str,
    height: int,
    width: int,
    window: Sequence[int],
    layout: str = "auto",
    on_bad_image: Policy = "fail",
    cache: ImageCache | None = None,
    disparities: str | None = None,
    test_root: str | None = None,
    selection: str = "every_8th",
    index: str | None = None,
    val_scenes: int = 8,
    targets_may_be_inputs: bool = False,
    test_sets: Mapping[str, Any] | None = None,
    **options,
) -> SceneDataModule:
    """Build a data module of scenes on disk.

    The arguments are those of FilesSource and `scene_data`. A further test set may have its own
    root, layout, selection, index and size; one whose root is null is left out, with a warning.
    """

    make_source = partial(
        FilesSource,
        window=window,
        on_bad_image=on_bad_image,
        cache=cache,
        disparities=disparities,
    )
    changeable = {
        "height": height,
        "width": width,
        "layout": layout,
        "selection": selection,
        "index": index,
    }
    source = make_source(
        root=root,
        test_root=test_root,
        val_scenes=val_scenes,
        targets_may_be_inputs=targets_may_be_inputs,
        **changeable,
    )
    changeable["root"] = test_root or root
    _warn_of_untested(test_sets or {}, options["name"])
    tested = tested_sets(test_sets, options["name"], on_disk=True)
    return scene_data(source, make_source, changeable, test_sets=tested, **options)


def scene_data(
    source: Source,
    make_source: Callable[..., Source],
    changeable: dict[str, Any],
    name: str,
    inputs: int,
    targets: int,
    test_sets: Mapping[str, Any] | None = None,
    test_size: Sequence[int] | None = None,
    **options,
) -> SceneDataModule:
    """Build a data module that is tested on further sets as well.

    Args:
        source: the data set itself.
        make_source: makes the source of a test set from options like `changeable`.
        changeable: the options in which test sets may differ from the data set, with the data
            set's values; height and width are among them.
        test_sets: name -> the options that differ: any of `changeable`, inputs and targets.
        test_size: height and width of all tests, but of sets that have their own; None: as trained.
        name, inputs, targets, options: those of SceneDataModule.

    Raises:
        InputError: a test set with the name of the data set, or with an unknown option.
    """
    main = {"inputs": inputs, "targets": targets, **changeable}
    sets = {}
    if test_size is not None:
        main["height"], main["width"] = test_size
        sets[name] = partial(_test_tasks, make_source, **main)
    for other, changes in (test_sets or {}).items():
        _check_test_set(other, changes, name, main)
        sets[other] = partial(_test_tasks, make_source, **{**main, **changes})
    return SceneDataModule(
        name=name,
        source=source,
        inputs=inputs,
        targets=targets,
        height=changeable["height"],
        width=changeable["width"],
        test_sets=sets,
        **options,
    )


def tested_sets(test_sets: Mapping[str, Any] | None, name: str, on_disk: bool) -> dict[str, Any]:
    """Choose the further test sets of a configuration that a run tests.

    A set without a root of its own is always tested. One with a root is tested only by data on
    disk, if the root is given and the set has another name than the data; synthetic data tests
    synthetic scenes alone.

    Args:
        test_sets: name -> the options in which it differs from the data set.
        name: the data set's.
        on_disk: whether the data set is read from disk.
    """
    return {
        other: options
        for other, options in (test_sets or {}).items()
        if not _has_root(options) or (on_disk and options["root"] is not None and other != name)
    }


def _has_root(options: Any) -> bool:
    return isinstance(options, Mapping) and "root" in options


def _warn_of_untested(test_sets: Mapping[str, Any], name: str) -> None:
    lacking = [
        other
        for other, options in test_sets.items()
        if _has_root(options) and options["root"] is None and other != name
    ]
    if lacking:
        warnings.warn(
            f"Not tested for want of a path: {', '.join(lacking)}. To test them, add "
            f"{' '.join(f'paths.{other}=...' for other in lacking)} to the command.",
            stacklevel=3,
        )


def _test_tasks(
    make_source: Callable[..., Source], inputs: int, targets: int, **options: Any
) -> list[Task]:
    return make_source(**options).evaluation("test", inputs, targets)


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
