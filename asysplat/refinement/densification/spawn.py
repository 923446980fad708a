"""Densification by rendering errors: spawn Gaussians at pixels with a large error."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.geometry.isotropic import isotropic_gaussians
from asysplat.refinement.densification import Densifier
from asysplat.refinement.fields import Fields
from asysplat.refinement.footprints import random_permutation
from asysplat.refinement.hull import is_outside
from asysplat.rendering import render
from asysplat.scene import Gaussians, Views

MIN_OPACITY = 0.005  # Gaussians below it are pruned (Kerbl et al. 2023)
SPAWN_SIZE = 0.5  # standard deviation of a new Gaussian, in pixels
SPAWN_OPACITY = 0.1
ERROR_WINDOW = 3  # pixels over which errors are averaged, as a single one may be noise
VIEWS_PER_ROUND = 8  # rendered to find pixels with large errors


class ErrorDensifier(Densifier):
    """Prunes faint and unseen Gaussians, and spawns others at pixels with a large error."""

    def __init__(
        self,
        fields: Fields,
        generator: torch.Generator,
        background: Float[Tensor, "3"],
        units: Callable[[Tensor], Tensor],  # units of the offsets at positions, see `Fields`
    ):
        self.fields, self.generator, self.background = fields, generator, background
        self.units, self._steps = units, 0
        self._last_visible = torch.zeros_like(fields.units, dtype=torch.long)

    def observe_step(self, visible: Bool[Tensor, "N"], factor: float) -> None:
        self._steps += 1
        self._last_visible.masked_fill_(visible, self._steps)  # an index would wait for a GPU

    @torch.no_grad()
    def densify(self, views: Views, target: int) -> None:
        opacities = self.fields.parameters["logits"].sigmoid()
        # Every view has been used twice since.
        unseen = self._steps - self._last_visible > 2 * views.num_views
        useful = (opacities > MIN_OPACITY) & ~unseen
        if views.alphas is not None:
            useful &= ~is_outside(self.fields.gaussians().means, views)
        useful[opacities.argmax()] = True  # never prune all
        rows = torch.nonzero(useful)[:, 0]
        self.fields.keep(rows)
        self._last_visible = self._last_visible[rows]
        count = target - len(self.fields)
        if count > 0:
            order = random_permutation(views.num_views, self.generator)
            views = views.select(order[:VIEWS_PER_ROUND]).decoded()
            gaussians = self.fields.gaussians()
            background, cameras = self.background, views.cameras
            out = render(gaussians, cameras, background, depth="median", views_at_once=1)
            assert out.depth is not None
            new = spawn_at_errors(views, out.image, out.depth, count, self.generator)
            self.fields.append(new, self.units(new.means))
            visible = self._last_visible.new_full((new.num_gaussians,), self._steps)
            self._last_visible = torch.cat((self._last_visible, visible))


@torch.no_grad()
def spawn_at_errors(
    views: Views,
    rendered: Float[Tensor, "V 3 H W"],
    depth: Float[Tensor, "V H W"],
    count: int,
    generator: torch.Generator,
) -> Gaussians:
    """Sample pixels in proportion to their error, and return a Gaussian at the depth of each.

    Each has the color of its pixel in the input image. The rendered `depth` is 0 at the background.
    There are fewer than `count` where fewer pixels have an error.
    """
    error = (views.masked(rendered) - views.images).abs().mean(1)
    error = F.avg_pool2d(error, ERROR_WINDOW, stride=1, padding=ERROR_WINDOW // 2) * (depth > 0)
    if views.masks is not None:
        error = error * views.masks
    if views.alphas is not None:
        error = error * (views.alphas > 0)
    count = min(count, int((error > 0).sum()))
    # torch.multinomial is limited to 2^24 pixels. The smallest of exponential times with these
    # rates sample the same distribution (Efraimidis and Spirakis 2006).
    times = torch.empty(error.shape, device=error.device)
    times = times.exponential_(generator=generator).clamp_min(1e-30)
    sampled = (error / times.to(error)).flatten().topk(count).indices
    cameras = views.cameras
    view = sampled // error[0].numel()
    directions = cameras.pixel_directions().flatten(0, 2)[sampled]
    z = depth.flatten()[sampled]
    pose = cameras.cam_to_world[view]
    means = (pose[:, :3, :3] @ (z[:, None] * directions)[..., None])[..., 0] + pose[:, :3, 3]
    sizes = SPAWN_SIZE * z / cameras.intrinsics[view, 0, 0]
    colors = views.images.movedim(1, -1).flatten(0, 2)[sampled]
    return isotropic_gaussians(means, sizes, torch.full_like(z, SPAWN_OPACITY), colors)
