"""Gaussians are cloned and split where their images are pulled, as 3DGS itself densifies.

"3D Gaussian Splatting for Real-Time Radiance Field Rendering", Kerbl et al. 2023, Sec. 5.2, with
the numbers of the paper's code: what `densify="error"` is measured by, as by `relocate`. That
opacities fall to 0.01 every 3,000 steps is left out: few refinements have as many.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.refinement.densify import LEAST_OPACITY
from asysplat.refinement.fields import Fields
from asysplat.rendering.reference.math import rotations
from asysplat.scene import Cameras

PULLED = 2e-4  # mean gradient, over half an image, from which on a Gaussian becomes two
LARGE = 0.011  # size from which on it is split, in the scene's unit: 1 % of the paper's extent, 1.1
SHRUNK = 1.6  # times smaller are the two that a large one is split into


class Pulls:
    """How strongly the images of Gaussians are pulled: means over the photographs that see them.

    Args:
        fields: of the Gaussians.
    """

    def __init__(self, fields: Fields):
        self.fields = fields
        self._forget()

    def _forget(self) -> None:
        self._sums = torch.zeros(len(self.fields))
        self._counts = torch.zeros(len(self.fields))

    @property
    def mean(self) -> Float[Tensor, "N"]:
        """The length of the gradient of a center's place in an image of sides from -1 to 1."""
        return self._sums / self._counts.clamp_min(1)

    @torch.no_grad()
    def add(self, gradients: Float[Tensor, "N 3"], cameras: Cameras) -> None:
        """Note the gradients of the offsets from one photograph.

        A center's place in the image moves with its place across the camera's axis; that the shape
        of its image changes too is left out.

        Args:
            gradients: 0 where a Gaussian is not seen.
            cameras: of the photograph, [1].
        """
        seen = gradients.any(dim=1)
        pose, pixels = cameras.cam_to_world[0], cameras.intrinsics[0]
        means = self.fields.gaussians().means[seen]
        across = (gradients[seen] / self.fields.units[seen, None]) @ pose[:3, :2]
        depth = (means - pose[:3, 3]) @ pose[:3, 2]
        half = gradients.new_tensor([cameras.width / 2, cameras.height / 2])
        pulls = across * depth[:, None] / pixels.diagonal()[:2] * half
        self._sums[seen] += pulls.norm(dim=1)
        self._counts[seen] += 1

    @torch.no_grad()
    def clone_and_split(self, most: int, generator: torch.Generator) -> None:
        """Clone small Gaussians that are pulled and split large ones, then drop transparent ones.

        A clone is where the other is. Then the pulls are forgotten.

        Args:
            most: Gaussians up to which some are added, those that are pulled most first.
            generator: of random numbers.
        """
        fields, gaussians = self.fields, self.fields.gaussians()
        useful = gaussians.opacities > LEAST_OPACITY
        useful[gaussians.opacities.argmax()] = True  # one is left
        doubled = self._most_pulled(useful, max(0, most - int(useful.sum())))
        large = gaussians.scales.amax(1) > LARGE
        small, split = (torch.nonzero(doubled & which)[:, 0] for which in (~large, large))
        twice = split.repeat(2)
        halves = gaussians.map(lambda field: field[twice])
        away = halves.scales * torch.randn(len(twice), 3, generator=generator)
        moved = (rotations(halves.quats) @ away[..., None])[..., 0]
        halves = replace(halves, means=halves.means + moved, scales=halves.scales / SHRUNK)
        units = fields.units
        fields.keep(torch.nonzero(useful & ~(doubled & large))[:, 0])
        fields.append(gaussians.map(lambda field: field[small]), units[small])
        fields.append(halves, units[twice])
        self._forget()

    def _most_pulled(self, useful: Bool[Tensor, "N"], room: int) -> Bool[Tensor, "N"]:
        """Return which are pulled enough to be doubled: `room` at most."""
        pulls = torch.where(useful, self.mean, 0)
        chosen = torch.zeros_like(useful)
        first = pulls.topk(min(room, len(pulls))).indices
        chosen[first] = pulls[first] > PULLED
        return chosen
