"""Augmentation of training tasks: the order of the inputs, and a crop; never in evaluation.

As in Long-LRM (arXiv 2410.12781).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn.functional import interpolate

from asysplat.errors import InputError
from asysplat.scene import Views


@dataclass(frozen=True)
class Augmentation:
    """How much training tasks vary.

    Args:
        reverse, shuffle: how likely the inputs are given backwards, and in random order.
        crop: the least share of the sides that a crop keeps; 1 crops nothing.

    Raises:
        InputError: a probability outside [0, 1], or a share outside (0, 1].
    """

    reverse: float = 0.0
    shuffle: float = 0.0
    crop: float = 1.0

    def __post_init__(self):
        for name in ("reverse", "shuffle", "crop"):
            value = getattr(self, name)
            if not 0 <= value <= 1 or (name == "crop" and value == 0):
                raise InputError(
                    f"data.augmentation.{name} is {value}: give a number from 0 to 1"
                    f"{', and not 0' if name == 'crop' else ''}."
                )

    def order(self, inputs: Sequence[int], rng: np.random.Generator) -> list[int]:
        """Return the same frames, maybe in another order."""
        ordered = list(inputs)
        if rng.random() < self.reverse:
            ordered.reverse()
        if rng.random() < self.shuffle:
            rng.shuffle(ordered)
        return ordered

    def share(self, rng: np.random.Generator) -> float:
        """Draw the share of the sides that a crop keeps; one for all views of a task."""
        return float(rng.uniform(self.crop, 1.0))


def cropped(views: Views, share: float) -> Views:
    """Crop every view to its middle, enlarged to the size that the views had.

    Cut out at whole pixels and enlarged: images bilinearly, depths and masks without mixing. The
    intrinsics follow exactly; poses stay as they are.

    Args:
        views: [V, ...].
        share: of the sides to keep, in (0, 1].
    """
    height, width = views.cameras.height, views.cameras.width
    rows, columns = max(1, round(share * height)), max(1, round(share * width))
    if (rows, columns) == (height, width):
        return views
    top, left = (height - rows) // 2, (width - columns) // 2

    images = views.images[..., top : top + rows, left : left + columns]
    # The pixel under each new centre.
    y = top + (torch.arange(height) + 0.5) * rows // height
    x = left + (torch.arange(width) + 0.5) * columns // width
    nearest = (..., y.long()[:, None], x.long())
    intrinsics = views.cameras.intrinsics.clone()
    intrinsics[:, 0, 2] -= left
    intrinsics[:, 1, 2] -= top
    cameras = replace(views.cameras, intrinsics=intrinsics, height=rows, width=columns)
    return Views(
        cameras=cameras.resized(height, width),
        images=interpolate(images, (height, width), mode="bilinear"),
        depths=None if views.depths is None else views.depths[nearest],
        masks=None if views.masks is None else views.masks[nearest],
    )
