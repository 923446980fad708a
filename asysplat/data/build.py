"""Build the data module of a configuration in `conf/data`, with its further test sets."""

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

from asysplat.data.datamodule import SceneDataModule
from asysplat.data.images import Resampling
from asysplat.data.sequence import SceneOptions
from asysplat.data.sources import FilesSource, ProceduralSource, Source, Task, has_root, tested_sets
from asysplat.errors import InputError
from asysplat.ranges import check_options

SIZE = ("height", "width")
MODULE_OPTIONS = set(inspect.signature(SceneDataModule).parameters) - {*SIZE, "source", "on_error"}


def procedural_data(test_sets: Mapping[str, Any] | None = None, **options) -> SceneDataModule:
    """Build a data module of synthetic scenes from its options and those of ProceduralSource.

    Args:
        test_sets: name -> the options in which a further test set differs: inputs, targets, height,
            width, num_images, test_scenes or places; and prune (see Task).
        options: also test_size, the height and width of every test set that does not set its own.
    """
    sets = tested_sets(test_sets, options["name"], on_disk=False)
    changeable = ("num_images", "test_scenes", "places")
    return _data_module(ProceduralSource, changeable, sets, {}, **options)


def files_data(test_sets: Mapping[str, Any] | None = None, **options) -> SceneDataModule:
    """Build a data module of scenes on disk from its options, FilesSource's and SceneOptions'.

    Args:
        test_sets: as for `procedural_data`, of inputs, targets, height, width, prune, layout,
            scenes, selection, index and root. A set whose root is null is left out, with a warning.
    """
    missing = [
        name
        for name, changes in (test_sets or {}).items()
        if has_root(changes) and changes["root"] is None and name != options["name"]
    ]
    if missing:
        warnings.warn(
            f"Not tested, because their paths are not set: {', '.join(missing)}. To test them, add "
            f"{' '.join(f'paths.{name}=...' for name in missing)} to the command.",
            stacklevel=2,
        )
    sets = tested_sets(test_sets, options["name"], on_disk=True)
    of_tests = {"root": options.get("test_root") or options["root"], "test_root": None}
    changeable = ("layout", "scenes", "selection", "index", "root")
    return _data_module(_files_source, changeable, sets, of_tests, **options)


def _files_source(**options: Any) -> FilesSource:
    names = {field.name for field in fields(SceneOptions)} & options.keys()
    scene = SceneOptions(**{name: options.pop(name) for name in names})
    check_options({"data.resampling": scene.resampling}, {"data.resampling": Resampling})
    return FilesSource(options=scene, **options)


def _data_module(
    make_source: Callable[..., Source],
    changeable: tuple[str, ...],
    test_sets: Mapping[str, Any],
    of_tests: Mapping[str, Any],
    test_size: Sequence[int] | None = None,
    **options: Any,
) -> SceneDataModule:
    """Build a data module; `of_tests` replaces options of the sources of tests."""
    module = {name: options[name] for name in MODULE_OPTIONS & options.keys()}
    scenes = {name: value for name, value in options.items() if name not in MODULE_OPTIONS}
    name, size = options["name"], {side: options[side] for side in SIZE}
    main = {**scenes, **of_tests, "inputs": options["inputs"], "targets": options["targets"]}
    sets = {}
    if test_size is not None:
        main["height"], main["width"] = test_size
        sets[name] = partial(_test_tasks, make_source, **main)
    changeable = ("inputs", "targets", "prune", *SIZE, *changeable)
    for test_set, changes in test_sets.items():
        where = f"data.test_sets.{test_set}"
        if test_set == name:
            raise InputError(f"{where} has the name of the data set itself: give it another name.")
        if not isinstance(changes, Mapping):
            raise InputError(
                f"{where} is {changes!r}: give the options that differ, such as {where}.inputs=16."
            )
        for option in changes:
            if option not in changeable:
                known = ", ".join(changeable)
                raise InputError(
                    f"{where}.{option} is no option of a test set: give any of {known}."
                )
        sets[test_set] = partial(_test_tasks, make_source, **{**main, **changes})
    module |= size | {"on_error": options.get("on_error", "fail")}
    return SceneDataModule(source=make_source(**scenes), test_sets=sets, **module)


def _test_tasks(
    make_source: Callable[..., Source],
    inputs: int,
    targets: int,
    prune: bool = True,
    **options: Any,
) -> list[Task]:
    tasks = make_source(**options).evaluation("test", inputs, targets)
    return [replace(task, prune=prune) for task in tasks]
