"""What stands in one photograph only, such as a car that drives by, to be left out of a fit."""

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

MOMENTS = (0.2, 0.6)  # progress at which a scene is drawn: it shows what most photographs agree on
CELLS = 28  # in an image's height: finer detail may be missing yet
MIN_CELL = 4  # pixels a side
CHANGED = 0.2  # least difference of a cell's mean color, more than detail makes
LEAST = 4  # such cells of 3 x 3: a single one may show a detail that is placed wrongly yet
DIFFERENT = 0.05  # least mean difference around a pixel that is left out, in or near such cells
RARE = 1 / 3  # share of photographs with such cells from which on it is the fit that fails


@torch.no_grad()
def find_transients(
    differences: Iterable[Float[Tensor, "1 3 H W"]],
) -> Bool[Tensor, "V H W"] | None:
    """Find the pixels of photographs that their renderings contradict.

    None without such pixels, and where many photographs have some.

    Args:
        differences: rendering minus photograph, one photograph after the other.
    """
    transient, has_some = [], []
    for difference in differences:
        size = height, width = tuple(difference.shape[-2:])
        cell = max(MIN_CELL, height // CELLS)
        cells = F.interpolate(difference, (-(-height // cell), -(-width // cell)), mode="area")
        changed = (cells.abs().mean(1, keepdim=True) > CHANGED).to(difference)
        has_some.append(changed.max())
        clumps = changed * (F.avg_pool2d(changed, 3, stride=1, padding=1) * 9 > LEAST - 0.5)
        around = F.interpolate(F.max_pool2d(clumps, 5, stride=1, padding=2), size)
        near = F.avg_pool2d(difference.abs().mean(1, keepdim=True), 3, stride=1, padding=1)
        transient.append(((around > 0) & (near > DIFFERENT))[0])
    return torch.cat(transient) if 0 < torch.stack(has_some).mean() < RARE else None
