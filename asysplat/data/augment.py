"""Augmentation of training tasks (never of evaluation): order of inputs, crop, exposure, noise.

Order and crop as in Long-LRM (arXiv 2410.12781).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from pydantic.dataclasses import dataclass
from torch.nn.functional import interpolate

from asysplat.ranges import Fraction, PositiveFraction, configured
from asysplat.scene import Views

GAMMA = 2.2  # gamma of images, about that of sRGB


@dataclass(frozen=True, config=configured("data.augmentation"))
class Augmentation:
    """Strength of the augmentations of training tasks.

    Args:
        reverse, shuffle: probability of inputs in reverse order, and in random order.
        crop: least fraction of the sides that a crop keeps; 1 crops nothing.
        exposure: greatest change in stops of a task, the same for its inputs and targets.
        white_balance: greatest change in stops of a task's red and blue, relative to its green.
        flicker: greatest change in stops of one input, relative to the other views.
        noise: greatest standard deviation of the noise in a task's inputs.
    """

    reverse: Fraction = 0.0
    shuffle: Fraction = 0.0
    crop: PositiveFraction = 1.0
    exposure: Fraction = 0.0
    white_balance: Fraction = 0.0
    flicker: Fraction = 0.0
    noise: Fraction = 0.0

    def order(self, inputs: Sequence[int], rng: np.random.Generator) -> list[int]:
        """Reverse and shuffle the inputs at random."""
        ordered = list(inputs)
        if rng.random() < self.reverse:
            ordered.reverse()
        if rng.random() < self.shuffle:
            rng.shuffle(ordered)
        return ordered

    def draw_crop(self, rng: np.random.Generator) -> float:
        """Draw the fraction of the sides that a crop keeps, the same for all views of a task."""
        return float(rng.uniform(self.crop, 1.0))

    def expose(
        self, inputs: Views, targets: Views, rng: np.random.Generator
    ) -> tuple[Views, Views]:
        """Vary the exposure of a task's views, and add noise to its inputs."""
        red, blue = rng.uniform(-self.white_balance, self.white_balance, 2)
        stops = rng.uniform(-self.exposure, self.exposure) + np.array([red, 0.0, blue])
        flicker = rng.uniform(-self.flicker, self.flicker, (inputs.cameras.num_views, 1))
        noise = rng.uniform(0, self.noise)
        inputs, targets = brighten(inputs, stops + flicker), brighten(targets, stops[None])
        if noise:
            inputs = inputs.decoded()
            grain = torch.from_numpy(rng.standard_normal(inputs.images.shape, np.float32))
            noisy = inputs.images + noise * grain.to(inputs.images)
            inputs = replace(inputs, images=noisy.clamp(0, 1))
        return inputs, targets


def brighten(views: Views, stops: Float[np.ndarray, "#V 3"]) -> Views:
    """Multiply the light of every view by 2^stops, for red, green and blue, and clip at 1.

    Images store light to the power of 1 / GAMMA.
    """
    if not stops.any():
        return views
    views = views.decoded()
    gains = torch.from_numpy(2 ** (stops / GAMMA)).to(views.images)
    return replace(views, images=(views.images * gains[..., None, None]).clamp(max=1))


def center_crop(views: Views, fraction: float) -> Views:
    """Crop every view around its center at whole pixels, and enlarge it to the original size.

    Images are resampled bilinearly, depths and masks by nearest neighbor. The intrinsics change
    accordingly; the poses stay.

    Args:
        fraction: fraction of each side to keep, in (0, 1].
    """
    height, width = views.cameras.height, views.cameras.width
    rows, columns = max(1, round(fraction * height)), max(1, round(fraction * width))
    if (rows, columns) == (height, width):
        return views
    top, left = (height - rows) // 2, (width - columns) // 2

    images = views.images[..., top : top + rows, left : left + columns]
    # The pixel under each new pixel center.
    y = top + (torch.arange(height) + 0.5) * rows // height
    x = left + (torch.arange(width) + 0.5) * columns // width
    nearest = (..., y.long()[:, None], x.long())
    intrinsics = views.cameras.intrinsics.clone()
    intrinsics[:, 0, 2] -= left
    intrinsics[:, 1, 2] -= top
    cameras = replace(views.cameras, intrinsics=intrinsics, height=rows, width=columns)
    maps = {name: getattr(views, name) for name in ("depths", "masks", "alphas", "disparities")}
    return Views(
        cameras=cameras.resized(height, width),
        images=interpolate(images, (height, width), mode="bilinear"),
        **{name: None if values is None else values[nearest] for name, values in maps.items()},
    )
