"""Input views at another size, and their mean color."""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.scene import Views


def resize(views: Views, height: int, width: int) -> Views:
    """Return views with images, masks and depths of another size.

    A pixel is masked in only where all pixels it covers are; a depth is that of the nearest pixel.
    """
    size, depths, masks = (height, width), views.depths, views.masks
    if depths is not None:
        depths = F.interpolate(depths[:, None], size, mode="nearest")[:, 0]
    if masks is not None:
        masks = F.interpolate(masks[:, None].float(), size, mode="area")[:, 0] == 1
    images = F.interpolate(views.images, size, mode="area")
    return Views(views.cameras.resized(*size), images, depths=depths, masks=masks)


def mean_color(views: Views) -> Float[Tensor, "3"]:
    """Compute the mean color of all pixels that are masked in; gray if there are none."""
    colors = views.images.movedim(-3, -1)
    if views.masks is not None:
        colors = colors[views.masks]
    return colors.flatten(0, -2).mean(0).nan_to_num(0.5)
