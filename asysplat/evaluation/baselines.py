"""Baselines without any training, to compare every PSNR with."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.scene import Cameras, Views


def mean_color_images(inputs: Views, targets: Views) -> Float[Tensor, "*batch Vt 3 H W"]:
    """Fill every target with one color: the mean color of the inputs of its scene."""
    return inputs.mean_color()[..., None, :, None, None].expand_as(targets.images)


def nearest_view_images(inputs: Views, targets: Views) -> Float[Tensor, "*batch Vt 3 H W"]:
    """Copy the nearest input view for every target; all images have one size.

    The nearest view minimizes distance / extent + angle / pi: the distance between the camera
    centers, the extent (the largest distance between two input centers), and the angle between the
    viewing directions. If all inputs share one center, the angle alone decides.
    """
    nearest = _dissimilarity(targets.cameras, inputs.cameras).argmin(-1)
    return inputs.images.take_along_dim(nearest[..., None, None, None], dim=-4)


BASELINES = {  # name in results: title in tables, and what draws the targets
    "mean_color": ("mean color", mean_color_images),
    "nearest_view": ("nearest view, copied", nearest_view_images),
}


def _dissimilarity(targets: Cameras, inputs: Cameras) -> Float[Tensor, "*batch Vt Vi"]:
    extent = _distances(inputs.centers, inputs.centers).amax((-2, -1), keepdim=True)
    distance = _distances(targets.centers, inputs.centers)
    cosine = targets.cam_to_world[..., :3, 2] @ inputs.cam_to_world[..., :3, 2].mT
    angle = cosine.clamp(-1, 1).acos()
    return distance / extent.where(extent > 0, torch.inf) + angle / torch.pi


def _distances(
    a: Float[Tensor, "*batch A 3"], b: Float[Tensor, "*batch B 3"]
) -> Float[Tensor, "*batch A B"]:
    return (a[..., :, None, :] - b[..., None, :, :]).norm(dim=-1)
