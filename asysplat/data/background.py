"""The background of an object: what transparent pixels show, or one color at all borders."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import decode

RING = 0.02  # width of the ring of border pixels, over the shorter side
MIN_BORDER = 0.9  # fraction of a border that shows the background
MIN_VIEWS = 0.8  # fraction of the photographs whose borders do
NOISE = 4.0  # tolerance, in median deviations of the borders from their colors
MIN_TOLERANCE, MAX_TOLERANCE = 0.02, 0.08  # range of the tolerance, in the largest channel
MAX_DIFFERENCE = 0.15  # between the colors of a border and of most
COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
Background = str | Sequence[float | int]  # auto, mean, a name in COLORS, or RGB in [0, 1]


def find_background(
    images: Float[Tensor, "V 3 H W"] | UInt8[Tensor, "V 3 H W"],
) -> tuple[Float[Tensor, "3"], Float[Tensor, "V H W"]] | None:
    """Find the color around an object that lies within all photographs; None if there is none.

    The tolerance is measured: it follows from how far borders deviate from their median colors.

    Returns:
        The color; and alphas: 0 where a pixel has the color of its photograph's border and is
        connected to the border by such pixels, else 1.
    """
    height, width = images.shape[-2:]
    ring = max(1, round(RING * min(height, width)))
    border = torch.ones(height, width, dtype=torch.bool)
    border[ring : height - ring, ring : width - ring] = False
    borders = decode(images[..., border]).movedim(1, -1)  # [V, P, 3]
    colors = borders.median(1).values
    color = colors.median(0).values
    deviations = (borders - colors[:, None]).abs().amax(-1)
    tolerance = (NOISE * deviations.median()).clamp_min(MIN_TOLERANCE)
    uniform = (deviations < tolerance).float().mean(1) > MIN_BORDER
    uniform &= (colors - color).abs().amax(-1) < MAX_DIFFERENCE
    if tolerance > MAX_TOLERANCE or uniform.float().mean() < MIN_VIEWS:
        return None
    alphas = []
    for image, own in zip(images, colors, strict=True):
        near = (decode(image) - own[:, None, None]).abs().amax(0) < tolerance
        alphas.append(~_outer(near.numpy().astype(np.uint8)))
    return color, torch.from_numpy(np.stack(alphas)).to(borders)


def _outer(near: UInt8[ndarray, "H W"]) -> Bool[ndarray, "H W"]:
    """Return the pixels of `near` that are connected to the border by others."""
    _, labels = cv2.connectedComponents(np.pad(near, 1, constant_values=1), connectivity=4)
    return labels[1:-1, 1:-1] == labels[0, 0]


def read_color(background: Background) -> Float[Tensor, "3"]:
    """Return the color of a name, or of numbers."""
    color = COLORS.get(background) if isinstance(background, str) else tuple(background)
    if color is None or len(color) != 3 or not all(0 <= value <= 1 for value in color):
        raise InputError(
            f"background={background}: give auto, mean, white, black, or red, green and blue from "
            "0 to 1, such as [0,0.5,0]."
        )
    return torch.tensor(color, dtype=torch.float32)


def color_name(color: Float[Tensor, "3"]) -> str:
    """Return a color's name, or its numbers."""
    values = tuple(color.tolist())
    named = next((name for name, known in COLORS.items() if known == values), None)
    return named or f"[{', '.join(f'{value:.2f}' for value in values)}]"
