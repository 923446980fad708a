"""What photographs are forgiven while Gaussians are fitted to them: exposure and pose."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.refinement.adam import VisibleAdam
from asysplat.refinement.settings import Rates
from asysplat.scene import Cameras


class Corrections:
    """A gain and an offset a channel, and a small rigid motion, of each photograph.

    Photographs that are not fitted to, and what is rendered later, have none: the mean gain is kept
    at 1, the mean offset and motion at 0.

    Args:
        count: of photographs, V.
        rates: those of 0 stay as they are.
    """

    def __init__(self, count: int, rates: Rates):
        self._rates = {"exposure": rates.exposure, "poses": rates.poses}
        self._adam = VisibleAdam(
            {"exposure": torch.zeros(count, 2, 3), "poses": torch.zeros(count, 2, 3)}, eps=1e-8
        )

    @property
    def wanted(self) -> bool:
        """Whether anything is corrected."""
        return any(self._rates.values())

    def leaves(self, view: int) -> dict[str, Tensor]:
        """Return the numbers of one photograph, [1, 2, 3] each, as leaves of a graph."""
        return {
            name: tensor[view : view + 1].detach().clone().requires_grad_()
            for name, tensor in self._adam.parameters.items()
        }

    def step(self, view: int, gradients: dict[str, Tensor], factor: float) -> None:
        """Move the numbers of one photograph, and all so that they stay 0 in the mean."""
        seen = torch.zeros(self._adam.num_rows, dtype=torch.bool)
        seen[view] = True
        whole = {}
        for name, gradient in gradients.items():
            whole[name] = torch.zeros_like(self._adam.parameters[name])
            whole[name][view] = gradient[0]
        self._adam.step(whole, {n: rate * factor for n, rate in self._rates.items()}, seen)
        for tensor in self._adam.parameters.values():
            tensor -= tensor.mean(0)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return all cameras with their corrected poses."""
        return moved_cameras(cameras, self._adam.parameters["poses"])


def moved_cameras(cameras: Cameras, motion: Float[Tensor, "V 2 3"]) -> Cameras:
    """Return cameras turned by a rotation vector and moved, both in their own axes."""
    turn, shift = motion.unbind(1)
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).unflatten(-1, (3, 3))
    pose = cameras.cam_to_world
    rotation = pose[:, :3, :3] @ torch.linalg.matrix_exp(cross)
    place = pose[:, :3, 3:] + pose[:, :3, :3] @ shift[..., None]
    top = torch.cat((rotation, place), dim=-1)
    return replace(cameras, cam_to_world=torch.cat((top, pose[:, 3:]), dim=1))


def exposed(
    images: Float[Tensor, "V 3 H W"], exposure: Float[Tensor, "V 2 3"]
) -> Float[Tensor, "V 3 H W"]:
    """Return images with gains, given as logarithms, and offsets."""
    gain, offset = exposure[..., None, None].unbind(1)
    return images * gain.exp() + offset
