"""What a refinement optimizes: the Gaussians' fields, and corrections of the poses."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.refinement.adam import SelectiveAdam
from asysplat.refinement.settings import Rates
from asysplat.scene import Cameras, Gaussians

MAX_SH_DEGREE = 3
LOGIT_EPS = 1e-6
Parameters = dict[str, Tensor]


class Fields:
    """Offsets of the means, quaternions, log scales, opacity logits and SH, with their optimizer.

    Each Gaussian has its own unit, the length of an offset of 1, so that one learning rate suits
    near and far ones. SH coefficients missing from `sh_degree` start at 0; None keeps the degree.
    """

    def __init__(
        self, gaussians: Gaussians, units: Float[Tensor, "N"], sh_degree: int | None = None
    ):
        self.count = gaussians.sh.shape[1] if sh_degree is None else (sh_degree + 1) ** 2
        self._origins, parameters = self._unconstrained(gaussians)
        self.units = units.to(self._origins)
        self.optimizer = SelectiveAdam(parameters)
        self.parameters = self.optimizer.parameters

    def __len__(self) -> int:
        return len(self._origins)

    def leaves(self) -> Parameters:
        """Return the parameters as leaves of a graph."""
        return {name: tensor.detach().requires_grad_() for name, tensor in self.parameters.items()}

    def gaussians(self, parameters: Mapping[str, Tensor] | None = None) -> Gaussians:
        """Return the Gaussians of given or current parameters, differentiable in them."""
        parameters = self.parameters if parameters is None else parameters
        return Gaussians(
            means=torch.addcmul(self._origins, self.units[:, None], parameters["offsets"]),
            quats=parameters["quats"],
            scales=parameters["log_scales"].exp(),
            opacities=parameters["logits"].sigmoid(),
            sh=parameters["sh"],
        )

    def step(
        self,
        gradients: Parameters,
        rates: Rates,
        factor: float,
        means_alone: bool = False,
        sh_degree: int = MAX_SH_DEGREE,
    ) -> Bool[Tensor, "N"]:
        """Update the visible Gaussians (with a gradient of the opacity); return their mask.

        `factor` multiplies all rates, or those of the means alone. SH of degrees above `sh_degree`
        are not updated.
        """
        visible = gradients["logits"] != 0
        bands = np.full((self.count, 1), rates.sh * rates.sh_rest, np.float32)
        bands[0] = rates.sh
        bands[(sh_degree + 1) ** 2 :] = 0
        of_others = 1 if means_alone else factor
        scaled = {
            "offsets": rates.means * factor,
            "quats": rates.quats * of_others,
            "log_scales": rates.scales * of_others,
            "logits": rates.opacities * of_others,
            "sh": bands * of_others,
        }
        self.optimizer.step(gradients, scaled, visible)
        return visible

    def reset_opacities(self, greatest: float) -> None:
        """Lower all opacities to at most `greatest`, and forget what the optimizer knew of them."""
        logits = self.parameters["logits"]
        logits.clamp_(max=math.log(greatest / (1 - greatest)))
        self.optimizer.reset("logits")

    def decay_opacities(self, factor: float) -> None:
        """Multiply all opacities by a factor."""
        logits = self.parameters["logits"]
        logits.copy_((factor * logits.sigmoid()).logit(eps=LOGIT_EPS))

    def keep(self, index: Int[Tensor, "M"]) -> None:
        """Keep the rows of `index`."""
        self.optimizer.keep(index)
        self._origins, self.units = self._origins[index], self.units[index]

    def append(self, gaussians: Gaussians, units: Float[Tensor, "M"]) -> None:
        """Add Gaussians, with a new optimizer state."""
        origins, parameters = self._unconstrained(gaussians)
        self.optimizer.append(parameters)
        self._origins = torch.cat((self._origins, origins))
        self.units = torch.cat((self.units, units.to(self.units)))

    def _unconstrained(self, gaussians: Gaussians) -> tuple[Float[Tensor, "N 3"], Parameters]:
        """Return the origins of the offsets, and the parameters: copies in float32."""
        gaussians = gaussians.map(
            lambda field: field.detach().float().clone(memory_format=torch.contiguous_format)
        )
        sh = gaussians.sh[:, : self.count]
        missing = sh.new_zeros(len(sh), self.count - sh.shape[1], 3)
        return gaussians.means, {
            "offsets": torch.zeros_like(gaussians.means),
            "quats": gaussians.quats,
            "log_scales": gaussians.scales.log(),
            "logits": gaussians.opacities.logit(eps=LOGIT_EPS),
            "sh": torch.cat((sh, missing), dim=1),
        }


class Motions:
    """A small rigid motion of each input camera, of mean 0; none with rate 0."""

    def __init__(self, count: int, rate: float, device: torch.device):
        self._rate = rate
        self._adam = SelectiveAdam({"poses": torch.zeros(count, 2, 3, device=device)}, eps=1e-8)

    def append(self, count: int) -> None:
        """Add so many cameras that did not move."""
        motions = self._adam.parameters["poses"]
        self._adam.append({"poses": motions.new_zeros(count, 2, 3)})

    def leaves(self) -> list[Float[Tensor, "V 2 3"]]:
        """Return the motions of all cameras as a leaf of a graph; none with rate 0."""
        motions = self._adam.parameters.values() if self._rate else ()
        return [motion.detach().requires_grad_() for motion in motions]

    def step(self, view: int, gradient: Float[Tensor, "V 2 3"], factor: float) -> None:
        """Update the motion of one camera, then subtract the mean over all cameras."""
        motions = self._adam.parameters["poses"]
        visible = torch.arange(len(motions), device=motions.device) == view
        self._adam.step({"poses": gradient}, {"poses": self._rate * factor}, visible)
        motions -= motions.mean(0)


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
