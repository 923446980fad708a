"""Densification of 3DGS: clone and split Gaussians with large screen-space gradients.

Kerbl et al. 2023, Sec. 5.2, with the constants of its code.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.geometry.motion import rotations
from asysplat.refinement.densification import Densifier
from asysplat.refinement.densification.spawn import MIN_OPACITY
from asysplat.refinement.fields import Fields
from asysplat.refinement.footprints import random_normal
from asysplat.scene import Cameras, Views

DENSIFY_GRAD_THRESHOLD = 2e-4  # mean screen-space gradient, in half images
SPLIT_SCALE = 0.011  # scale above which a Gaussian is split: 1 % of the scene extent of 1.1
SPLIT_FACTOR = 1.6  # factor by which the two halves are smaller
MAX_SCALE = 0.11  # above it a Gaussian is pruned, after the first opacity reset: 10 % of the extent
MAX_RADIUS = 20.0  # likewise, in pixels of any image: three standard deviations
MAX_RESET_OPACITY = 0.01


class CloneSplitDensifier(Densifier):
    """Clones and splits by the gradients since the last round."""

    def __init__(
        self,
        fields: Fields,
        generator: torch.Generator,
        max_gaussians: int,
        first_reset: int | None,  # step of the first opacity reset; then large ones are pruned
    ):
        self.generator, self.max_gaussians, self.first_reset = generator, max_gaussians, first_reset
        self._gradients, self._steps = ScreenGradients(fields), 0

    def observe_view(self, gradients: Float[Tensor, "N 3"], cameras: Cameras) -> None:
        self._gradients.add(gradients, cameras)

    def observe_step(self, visible: Bool[Tensor, "N"], factor: float) -> None:
        self._steps += 1

    def densify(self, views: Views, target: int) -> None:
        prune_large = self.first_reset is not None and self._steps > self.first_reset
        self._gradients.clone_and_split(self.max_gaussians, self.generator, prune_large)


class ScreenGradients:
    """Mean norms of the screen-space gradients of Gaussians, over the views that show them."""

    def __init__(self, fields: Fields):
        self.fields = fields
        self._reset()

    def _reset(self) -> None:
        self._sums, self._counts, self._radii = self.fields.units.new_zeros(3, len(self.fields))

    @property
    def mean(self) -> Float[Tensor, "N"]:
        """Mean gradient norm of a center's image position, in an image with sides [-1, 1]."""
        return self._sums / self._counts.clamp_min(1)

    @torch.no_grad()
    def add(self, gradients: Float[Tensor, "N 3"], cameras: Cameras) -> None:
        """Accumulate the gradients of the offsets from one view, 0 where a Gaussian is hidden."""
        visible = gradients.any(dim=1)
        gaussians = self.fields.gaussians()
        means, scales = gaussians.means[visible], gaussians.scales[visible].amax(-1)
        of_means = gradients[visible] / self.fields.units[visible, None]
        norms, depth = screen_gradients(means, of_means, cameras)
        self._sums[visible] += norms
        self._counts[visible] += 1
        radii = 3 * scales * cameras.intrinsics[0, 0, 0] / depth
        self._radii[visible] = torch.maximum(self._radii[visible], radii)

    @torch.no_grad()
    def clone_and_split(
        self, max_gaussians: int, generator: torch.Generator, prune_large: bool = False
    ) -> None:
        """Clone small and split large Gaussians with large gradients; prune transparent ones.

        A clone has the position of its original. Gaussians are added up to the limit, those with
        the largest gradients first. With `prune_large`, those above MAX_SCALE or MAX_RADIUS are
        pruned too. Afterwards the gradients are reset.
        """
        fields, gaussians = self.fields, self.fields.gaussians()
        opaque = gaussians.opacities > MIN_OPACITY
        if prune_large:
            opaque &= (gaussians.scales.amax(1) <= MAX_SCALE) & (self._radii <= MAX_RADIUS)
        opaque[gaussians.opacities.argmax()] = True  # never prune all
        gradients = torch.where(opaque, self.mean, 0)
        room = max(0, max_gaussians - int(opaque.sum()))
        largest = gradients.topk(min(room, len(gradients))).indices
        selected = torch.zeros_like(opaque)
        selected[largest] = gradients[largest] > DENSIFY_GRAD_THRESHOLD
        large = gaussians.scales.amax(1) > SPLIT_SCALE
        cloned, split = (torch.nonzero(selected & rows)[:, 0] for rows in (~large, large))
        twice = split.repeat(2)
        halves = gaussians.map(lambda field: field[twice])
        noise = halves.scales * random_normal(len(twice), 3, generator)
        shift = (rotations(halves.quats) @ noise[..., None])[..., 0]
        halves = replace(halves, means=halves.means + shift, scales=halves.scales / SPLIT_FACTOR)
        units = fields.units
        fields.keep(torch.nonzero(opaque & ~(selected & large))[:, 0])
        fields.append(gaussians.map(lambda field: field[cloned]), units[cloned])
        fields.append(halves, units[twice])
        self._reset()


def screen_gradients(
    means: Float[Tensor, "N 3"], gradients: Float[Tensor, "N 3"], cameras: Cameras
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Compute norms of the gradients of centers' image positions, and the centers' depths.

    Only the projection of the center is considered, not the change of the splat's shape. The view
    shows all `means`, and its image has sides [-1, 1].
    """
    pose, intrinsics = cameras.cam_to_world[0], cameras.intrinsics[0]
    depth = (means - pose[:3, 3]) @ pose[:3, 2]
    half = gradients.new_tensor([cameras.width / 2, cameras.height / 2])
    screen = (gradients @ pose[:3, :2]) * depth[:, None] / intrinsics.diagonal()[:2] * half
    return screen.norm(dim=1), depth
