"""What another system's scenes are measured on, and made of."""

import glob
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import MISSING, DictConfig

from asysplat.runs.run_config import plain_options
from asysplat.runs.runs import content_of, hash_of, name_of
from asysplat.runs.summary import TESTED

SYSTEM = "evaluation/system"
# Options of the data that choose the images of a test, and their size.
IMAGES = ("inputs", "targets", "height", "width", "selection")
IMAGES += ("num_images", "test_scenes", "places")  # options of procedural scenes


def describe_system(config: DictConfig, system: str, made_of: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a system, and what it is measured on, for evaluation.json.

    Args:
        made_of: what its scenes depend on, such as `contents_below` their files.
    """
    tested = options_of_test(config, config.data.name)
    return {
        SYSTEM: system,
        "evaluation/made_of": hash_of(made_of),
        **{f"{TESTED}{key}": value for key, value in tested.items()},
    }


def contents_below(path: Path) -> dict[str, Any]:
    """Return the content of a file, with its cameras, or of the files of a folder of scenes."""
    folder, stem = path, "*"
    if path.is_file():
        folder, stem = path.parent, glob.escape(path.stem)
    patterns = (f"{stem}.*", f"{stem}/*.*", f"{stem}/*/*/*")  # Gaussians, images, a COLMAP model
    files = [file for pattern in patterns for file in folder.glob(pattern) if file.is_file()]
    return {str(file.relative_to(folder)): content_of(file) for file in files}


def options_of_test(config: DictConfig, test_set: str) -> dict[str, Any]:
    """Return the options that the numbers of a test set depend on, whatever is measured on it.

    They are the data, its images and their size, and the metrics; missing values are left out.
    """
    data = plain_options(config.data)
    changes = (data["test_sets"] or {}).get(test_set) or {}
    if data.get("test_size"):
        data["height"], data["width"] = data["test_size"]
    data["root"] = data.get("test_root") or data.get("root")
    data |= changes
    options = {key: value for key, value in data.items() if key in IMAGES}
    options["data"] = test_set if "root" in changes else data["name"]
    options["root"] = name_of(data["root"])
    options["index"] = content_of(data.get("index"))
    metrics = plain_options(config.metrics)
    options |= {f"metrics.{key}": value for key, value in metrics.items() if key != "_target_"}
    return {key: value for key, value in options.items() if value not in (None, MISSING)}
