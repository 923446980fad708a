"""Scaffold-GS: Gaussians that small networks derive from anchors, anew for each view.

Lu et al. 2024, with the constants of its code (city-super/Scaffold-GS), without appearance codes.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass
from scipy.spatial import KDTree
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.ops.image_loss import image_loss
from asysplat.ranges import Count, Fraction, configured
from asysplat.refinement.adam import SelectiveAdam
from asysplat.refinement.densification.clone_split import screen_gradients
from asysplat.refinement.fields import Parameters
from asysplat.refinement.footprints import random_order
from asysplat.refinement.refine import RefinementProgress, read_budget, run_steps
from asysplat.refinement.settings import read_settings
from asysplat.rendering import Rendering, render
from asysplat.scene import Cameras, Gaussians, Views

OFFSETS = 10  # Gaussians of an anchor
FEATURES = 32  # numbers that describe an anchor, and width of the networks' hidden layer
MAX_INITIAL_ANCHORS = 100_000  # of ours: each step of a laptop decodes those that a view sees
OUTPUTS = {"opacity": 1, "covariance": 7, "color": 3}  # numbers for each Gaussian
SSIM, VOLUME = 0.2, 0.01  # weights of 1 - SSIM and of the mean volume beside L1
EXTENT = 1.1  # extent of a scene by the distance of its farthest camera, which is 1 here
# Learning rates at the start and at the end; they fall exponentially.
RATES = {"offsets": (0.01 * EXTENT, 1e-4 * EXTENT), "features": (0.0075, 0.0075)}
RATES |= {"log_scales": (0.007, 0.007)}
NETWORK_RATES = {"opacity": (0.002, 2e-5), "covariance": (0.004, 0.004), "color": (0.008, 5e-5)}
GRADIENT = 2e-4  # mean screen-space gradient, in half images, from which anchors grow
LEVELS = ((16, 1, 0.5), (4, 2, 0.75), (1, 4, 0.875))  # by voxel, gradient, and fraction that grow
MIN_OPACITY = 0.005  # anchors whose Gaussians have less together, on average, are pruned
SEEN_OFTEN = 0.8  # fraction of a round in which an anchor must be seen; half of it for a Gaussian


@checked_dataclass(frozen=True, config=configured("refinement"))
class ScaffoldSettings:
    """Settings of a refinement by Scaffold-GS; `SCAFFOLD_GS` are those published."""

    voxel: Annotated[float, Field(gt=0, lt=1)]
    max_gaussians: Annotated[int, Field(ge=OFFSETS)] | None
    first_statistics: Count
    first_round: Count
    round: Count
    densify_until: Fraction

    @property
    def max_anchors(self) -> int:
        return sys.maxsize if self.max_gaussians is None else self.max_gaussians // OFFSETS

    @property
    def initial_limit(self) -> int:
        """The greatest number of anchors to start with."""
        return min(MAX_INITIAL_ANCHORS, self.max_anchors)


SCAFFOLD_GS: ScaffoldSettings = read_settings("scaffold_gs")


@dataclass(frozen=True)
class ViewGaussians:
    """The Gaussians of a view: `anchors` [A] are seen, and `shown` [A, OFFSETS] of theirs kept."""

    gaussians: Gaussians
    anchors: Int[Tensor, "A"]
    shown: Bool[Tensor, "A 10"]
    opacities: Float[Tensor, "A 10"]  # negative where not shown


class AnchorScene:
    """A scene of anchors, each with a feature, OFFSETS offsets, log scales, and three networks.

    An anchor is placed in each cell, of side `voxel`, that has a point.
    """

    def __init__(self, points: Float[Tensor, "P 3"], voxel: float, seed: int = 0):
        self.anchors = torch.unique(torch.round(points / voxel), dim=0) * voxel
        sizes = torch.full_like(self.anchors[:, 0], voxel)
        if len(self.anchors) > 3:
            nearest = KDTree(self.anchors.cpu()).query(self.anchors.cpu(), k=[2, 3, 4])[0]
            squares = torch.as_tensor(nearest).to(sizes).square().mean(-1)
            sizes = squares.clamp_min(1e-7).sqrt()
        self.optimizer = SelectiveAdam(_new_anchors(sizes))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            networks = {
                name: nn.Sequential(
                    nn.Linear(FEATURES + 3, FEATURES),
                    nn.ReLU(),
                    nn.Linear(FEATURES, count * OFFSETS),
                )
                for name, count in OUTPUTS.items()
            }
        self.networks = nn.ModuleDict(networks).to(self.anchors)

    @property
    def num_gaussians(self) -> int:
        """Number of the Gaussians of all anchors; a view shows some of them."""
        return len(self.anchors) * OFFSETS

    def decode(self, camera: Cameras, parameters: Parameters | None = None) -> ViewGaussians:
        """Compute the Gaussians of one view (Sec. 3.2), differentiable in given parameters."""
        anchors = self._seen(camera).nonzero()[:, 0]
        parameters = self.optimizer.parameters if parameters is None else parameters
        offsets, features, log_scales = (
            parameters[name][anchors] for name in ("offsets", "features", "log_scales")
        )
        centers = self.anchors[anchors]
        directions = F.normalize(centers - camera.centers[0], dim=-1)
        inputs = torch.cat((features, directions), dim=-1)
        opacities = self.networks["opacity"](inputs).tanh()
        shown = opacities > 0
        shapes = self.networks["covariance"](inputs).unflatten(-1, (OFFSETS, 7))[shown]
        colors = self.networks["color"](inputs).sigmoid().unflatten(-1, (OFFSETS, 3))[shown]
        reaches, sizes = log_scales.exp()[:, None].expand(-1, OFFSETS, -1)[shown].split(3, dim=-1)
        gaussians = Gaussians(
            means=centers[:, None].expand_as(offsets)[shown] + offsets[shown] * reaches,
            quats=F.normalize(shapes[:, 3:], dim=-1),
            scales=sizes * shapes[:, :3].sigmoid(),
            opacities=opacities[shown],
            sh=((colors - 0.5) / SH_C0)[:, None],
        )
        return ViewGaussians(gaussians, anchors, shown, opacities.detach())

    @torch.no_grad()
    def render(
        self,
        cameras: Cameras,
        background: Float[Tensor, "3"],
        masks: Bool[Tensor, "V H W"] | None = None,
        depth: bool = True,
    ) -> Rendering:
        """Render every view by its own Gaussians, without gradients; see `rendering.render`."""
        drawn = []
        for view in range(cameras.num_views):
            camera = cameras.select([view])
            mask = None if masks is None else masks[[view]]
            gaussians = self.decode(camera).gaussians
            drawn.append(render(gaussians, camera, background, depth=depth, masks=mask))
        depths = [rendering.depth for rendering in drawn if rendering.depth is not None]
        return Rendering(
            image=torch.cat([rendering.image for rendering in drawn]),
            alpha=torch.cat([rendering.alpha for rendering in drawn]),
            depth=torch.cat(depths) if depths else None,
            stats={},
        )

    def _seen(self, camera: Cameras) -> Bool[Tensor, "N"]:
        """Return the anchors within three of their sizes of the image."""
        pixels, depth, _ = camera.project(self.anchors)
        sizes = self.optimizer.parameters["log_scales"][:, :3].amax(-1).exp()
        radii = 3 * sizes * camera.intrinsics[0, 0, 0] / depth[0].clamp_min(1e-12)
        size = pixels.new_tensor([camera.width, camera.height])
        near = (pixels[0] >= -radii[:, None]) & (pixels[0] < size + radii[:, None])
        return (depth[0] > 0) & near.all(-1)

    @torch.no_grad()
    def grow(self, wanted: Bool[Tensor, "N 10"], voxel: float, limit: int = sys.maxsize) -> None:
        """Add an anchor in each empty cell with a wanted Gaussian, up to the limit (Sec. 3.3).

        Its feature is the greatest of the anchors of these Gaussians, by component.
        """
        anchors, slots = wanted.nonzero(as_tuple=True)
        offsets = self.optimizer.parameters["offsets"][anchors, slots]
        reaches = self.optimizer.parameters["log_scales"][anchors, :3].exp()
        points = self.anchors[anchors] + offsets * reaches
        both = torch.round(torch.cat((self.anchors, points)) / voxel)
        cells, cell_of = torch.unique(both, dim=0, return_inverse=True)
        empty = torch.ones(len(cells), dtype=torch.bool, device=cells.device)
        empty[cell_of[: len(self.anchors)]] = False
        empty = empty.nonzero()[: max(0, limit - len(self.anchors)), 0]
        features = self.optimizer.parameters["features"][anchors]
        greatest = features.new_full((len(cells), FEATURES), -torch.inf)
        rows = cell_of[len(self.anchors) :, None].expand_as(features)
        greatest.scatter_reduce_(0, rows, features, "amax")
        added = _new_anchors(features.new_full((len(empty),), voxel))
        self.optimizer.append(added | {"features": greatest[empty]})
        self.anchors = torch.cat((self.anchors, cells[empty] * voxel))

    def keep(self, index: Int[Tensor, "M"]) -> None:
        """Keep the anchors of `index`."""
        self.optimizer.keep(index)
        self.anchors = self.anchors[index]


class AnchorStatistics:
    """How often anchors and their Gaussians were seen, with which gradients and opacities."""

    def __init__(self, like: Tensor, count: int):
        self.opacities, self.seen = like.new_zeros(2, count)
        self.gradients, self.shown = like.new_zeros(2, count, OFFSETS)

    @torch.no_grad()
    def observe(
        self, decoded: ViewGaussians, of_means: Float[Tensor, "G 3"], camera: Cameras
    ) -> None:
        """Add a view, by the gradients of the means of its Gaussians, 0 where culled."""
        drawn = of_means.any(dim=1)
        norms, _ = screen_gradients(decoded.gaussians.means[drawn], of_means[drawn], camera)
        anchors, slots = decoded.shown.nonzero(as_tuple=True)
        anchors, slots = decoded.anchors[anchors[drawn]], slots[drawn]
        self.gradients[anchors, slots] += norms
        self.shown[anchors, slots] += 1
        self.opacities[decoded.anchors] += decoded.opacities.clamp_min(0).sum(-1)
        self.seen[decoded.anchors] += 1

    def keep(self, index: Int[Tensor, "M"]) -> None:
        """Keep the anchors of `index`."""
        for name, values in vars(self).items():
            setattr(self, name, values[index])

    def extend(self, count: int) -> None:
        """Add anchors that were never seen, up to `count`."""
        for name, values in vars(self).items():
            added = values.new_zeros(count - len(values), *values.shape[1:])
            setattr(self, name, torch.cat((values, added)))


class ScaffoldRefinement:
    """The state of a refinement by Scaffold-GS; see `refine_scaffold`."""

    def __init__(
        self,
        points: Float[Tensor, "P 3"],
        views: Views,
        background: Float[Tensor, "3"],
        settings: ScaffoldSettings,
        seed: int,
    ):
        self.views, self.background, self.settings = views, background, settings
        self.scene = AnchorScene(points, settings.voxel, seed)
        self._network_optimizer = torch.optim.Adam(
            [
                {"params": self.scene.networks[name].parameters(), "lr": start, "name": name}
                for name, (start, _) in NETWORK_RATES.items()
            ],
            eps=1e-15,
        )
        self._generator = torch.Generator(views.images.device).manual_seed(seed)
        self._statistics = AnchorStatistics(self.scene.anchors, len(self.scene.anchors))
        self._view_order, self._steps = random_order(views.num_views, self._generator), 0

    @property
    def num_gaussians(self) -> int:
        return self.scene.num_gaussians

    def advance(self, progress: float) -> Float[Tensor, ""]:
        """Grow and prune anchors where that is due, then take a step; return its squared error."""
        settings, steps = self.settings, self._steps
        growing = progress < settings.densify_until
        if growing and steps >= settings.first_round and steps % settings.round == 0:
            self.densify()
        observing = growing and steps >= settings.first_statistics
        self._steps += 1
        return self.step(progress, observing)

    def step(self, progress: float, observing: bool) -> Float[Tensor, ""]:
        """Take a step on one view; return its mean squared error."""
        scene, target = self.scene, self.views.one(next(self._view_order))
        camera = target.cameras
        parameters = scene.optimizer.parameters
        leaves = {name: tensor.detach().requires_grad_() for name, tensor in parameters.items()}
        decoded = scene.decode(camera, leaves)
        means, scales = decoded.gaussians.means, decoded.gaussians.scales
        drawn = render(decoded.gaussians, camera, self.background, depth=False, masks=target.masks)
        image = drawn.image
        loss = image_loss(image, target.images, SSIM, target.masks).sum()
        loss = loss + VOLUME * scales.prod(-1).sum() / max(1, len(scales))
        weights = [*scene.networks.parameters()]
        *gradients, of_means = torch.autograd.grad(loss, [*leaves.values(), *weights, means])
        for weight, gradient in zip(weights, gradients[len(leaves) :], strict=True):
            weight.grad = gradient
        for group in self._network_optimizer.param_groups:
            group["lr"] = _rate(*NETWORK_RATES[group["name"]], progress)
        self._network_optimizer.step()
        seen = torch.zeros_like(scene.anchors[:, 0], dtype=torch.bool)
        seen[decoded.anchors] = True
        rates = {name: _rate(*ends, progress) for name, ends in RATES.items()}
        of_anchors = dict(zip(leaves, gradients[: len(leaves)], strict=True))
        scene.optimizer.step(of_anchors, rates, seen)
        if observing:
            self._statistics.observe(decoded, of_means, camera)
        return F.mse_loss(target.masked(image.detach()), target.images)

    @torch.no_grad()
    def densify(self) -> None:
        """Add anchors at Gaussians with large gradients; prune transparent anchors (Sec. 3.3)."""
        scene, statistics, often = self.scene, self._statistics, SEEN_OFTEN * self.settings.round
        observed = statistics.shown > often / 2
        gradients = torch.where(observed, statistics.gradients / statistics.shown.clamp_min(1), 0)
        for size, factor, fraction in LEVELS:
            chance = torch.rand(gradients.shape, generator=self._generator, device=gradients.device)
            wanted = observed & (gradients >= factor * GRADIENT) & (chance < fraction)
            added = len(scene.anchors) - len(wanted)  # those of the levels before, which are new
            wanted = F.pad(wanted, (0, 0, 0, added))
            scene.grow(wanted, size * self.settings.voxel, self.settings.max_anchors)
        statistics.gradients[observed], statistics.shown[observed] = 0, 0
        statistics.extend(len(scene.anchors))
        settled = statistics.seen > often
        kept = ~settled | (statistics.opacities >= MIN_OPACITY * statistics.seen)
        kept[statistics.opacities.argmax()] = True  # never prune all
        statistics.opacities[settled], statistics.seen[settled] = 0, 0
        rows = kept.nonzero()[:, 0]
        scene.keep(rows)
        statistics.keep(rows)


def refine_scaffold(
    gaussians: Gaussians,
    views: Views,
    settings: ScaffoldSettings = SCAFFOLD_GS,
    *,
    seconds: float | int | None = None,
    steps: int | None = None,
    background: Float[Tensor, "3"] | None = None,
    seed: int = 0,
    watch: Callable[[RefinementProgress, ScaffoldRefinement], bool] | None = None,
) -> AnchorScene:
    """Optimize a scene of anchors, placed at the means of Gaussians, for some seconds or steps.

    The published schedule has 30,000 steps: in fewer, rates fall faster, and growth, which begins
    at `settings.first_round`, ends earlier. See `asysplat.refinement.refine` for the arguments.
    """
    budget = read_budget(seconds, steps)
    if gaussians.num_gaussians == 0:
        raise InputError("refine_scaffold got no Gaussians: start from at least one.")
    gaussians.validate("refine_scaffold's gaussians")
    views = views.validate("refine_scaffold's views").decoded()
    color = views.color_behind(views.mean_color()) if background is None else background
    points = gaussians.means.detach().float()
    if seconds is not None:  # a step with few anchors compiles the kernels before the time runs
        ScaffoldRefinement(points[:10], views, color, settings, seed).advance(0.0)
    refinement = ScaffoldRefinement(points, views, color, settings, seed)
    run_steps(refinement, budget, watch)
    return refinement.scene


def _new_anchors(sizes: Float[Tensor, "N"]) -> Parameters:
    return {
        "offsets": sizes.new_zeros(len(sizes), OFFSETS, 3),
        "features": sizes.new_zeros(len(sizes), FEATURES),
        "log_scales": sizes.log()[:, None].repeat(1, 6),
    }


def _rate(start: float, end: float, progress: float) -> float:
    """Return a learning rate that falls exponentially from `start` to `end`."""
    return start * (end / start) ** progress
