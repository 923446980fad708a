"""Exposure and pose corrections of the input images."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.refinement.adam import SelectiveAdam
from asysplat.refinement.settings import Rates
from asysplat.scene import Cameras


class Corrections:
    """A gain and an offset per channel, and a small rigid motion, of each input image.

    Held-out views and later renderings are not corrected: the mean gain is kept at 1, the mean
    offset and motion at 0. A correction with rate 0 is off.
    """

    def __init__(self, count: int, rates: Rates, device: torch.device):
        self._rates = {"exposure": rates.exposure, "poses": rates.poses}
        zeros = {name: torch.zeros(count, 2, 3, device=device) for name in self._rates}
        self._adam = SelectiveAdam(zeros, eps=1e-8)

    def leaves(self) -> dict[str, Float[Tensor, "V 2 3"]]:
        """Return the parameters of all images as leaves of a graph; none if both are off."""
        parameters = self._adam.parameters.items() if any(self._rates.values()) else ()
        return {name: tensor.detach().requires_grad_() for name, tensor in parameters}

    def step(self, view: int, gradients: dict[str, Tensor], factor: float) -> None:
        """Update the parameters of one image, then subtract the mean over all images."""
        parameters = self._adam.parameters
        visible = torch.arange(self._adam.num_rows, device=parameters["poses"].device) == view
        self._adam.step(gradients, {n: rate * factor for n, rate in self._rates.items()}, visible)
        for tensor in parameters.values():
            tensor -= tensor.mean(0)


def correct_poses(cameras: Cameras, motion: Float[Tensor, "V 2 3"]) -> Cameras:
    """Rotate cameras by rotation vectors, in radians, and translate them, in their own axes."""
    turn, shift = motion.unbind(1)
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
    pose = cameras.cam_to_world
    rotation = pose[:, :3, :3] @ torch.linalg.matrix_exp(cross)
    center = pose[:, :3, 3:] + pose[:, :3, :3] @ shift[..., None]
    top = torch.cat((rotation, center), dim=-1)
    return replace(cameras, cam_to_world=torch.cat((top, pose[:, 3:]), dim=1))


def correct_exposure(
    images: Float[Tensor, "V 3 H W"], exposure: Float[Tensor, "V 2 3"]
) -> Float[Tensor, "V 3 H W"]:
    """Apply gains, given as logarithms, and offsets per channel."""
    gain, offset = exposure[..., None, None].unbind(1)
    return images * gain.exp() + offset
