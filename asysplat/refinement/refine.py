"""Per-scene optimization of Gaussians; the paper's post-optimization is the setting `PAPER`."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Any, Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.kernels.dispatch import check_device
from asysplat.models.prior.prior import DepthEstimate
from asysplat.ops.image_loss import image_loss
from asysplat.ranges import Count, Positive, check_options
from asysplat.refinement.blur import find_blurred
from asysplat.refinement.densification import Densifier
from asysplat.refinement.densification.clone_split import MAX_RESET_OPACITY, CloneSplitDensifier
from asysplat.refinement.densification.relocate import McmcDensifier, mcmc_regularizer
from asysplat.refinement.densification.spawn import ErrorDensifier
from asysplat.refinement.fields import (
    MAX_SH_DEGREE,
    Fields,
    Motions,
    Parameters,
    correct_poses,
)
from asysplat.refinement.footprints import footprints, random_order
from asysplat.refinement.hull import within_hull
from asysplat.refinement.init import KnownDepths, initial_gaussians, sweep
from asysplat.refinement.settings import DEFAULT, RefinementSettings
from asysplat.refinement.transients import MOMENTS, find_transients
from asysplat.rendering import blending_weights, render
from asysplat.scene import Cameras, Gaussians, Views

COVERED = 0.5  # opacity of a pixel above which a place is not new
UNNEEDED = 0.005  # fraction of all blending weights, which 30 to 43 % of the Gaussians have


@dataclass(frozen=True)
class RefinementProgress:
    """Progress of a refinement."""

    step: int  # steps so far
    fraction: float  # fraction of the refinement that is done, in [0, 1]
    seconds: float  # seconds of its steps so far, without what watches it
    gaussians: int  # their number
    errors: Float[Tensor, "steps"]  # mean squared errors of as many steps as input images, at most

    @cached_property
    def psnr(self) -> float:
        """PSNR of the last steps, each before its update; a GPU is waited for, as it is read."""
        return -10 * math.log10(max(self.errors.double().mean().item(), 1e-10))


@runtime_checkable
class Refining(Protocol):
    """What `run_steps` drives."""

    views: Views

    @property
    def num_gaussians(self) -> int: ...

    def advance(self, progress: float) -> Float[Tensor, ""]:
        """Take a step at a progress in [0, 1]; return its mean squared error."""
        ...


class Refinement:
    """The state of a refinement: Gaussians, input views and the optimizer.

    Args:
        gaussians: [N], initial values.
        views: the input views, [V].
        background: RGB; None: what the views show behind an object, else their mean color.
        settings: what is optimized, and how.
        seed: seed of the order of views and of new Gaussians.
        estimate: that of `sweep`, if it is there; else the views are swept where depths are kept.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Views,
        background: Float[Tensor, "3"] | None = None,
        settings: RefinementSettings = DEFAULT,
        seed: int = 0,
        estimate: DepthEstimate | None = None,
    ):
        if gaussians.num_gaussians == 0:
            raise InputError("refine got no Gaussians: start from at least one.")
        gaussians.validate("refine's gaussians")
        views = views.validate("refine's views")
        check_device("refine", "views", views.images, "gaussians", gaussians.means)
        self.settings, self._estimate = settings, estimate
        if background is None:
            background = views.color_behind(views.mean_color())
        self.background = background
        self._generator = torch.Generator(gaussians.means.device).manual_seed(seed)
        self.motions = Motions(views.num_views, settings.rates.poses, views.images.device)
        self._steps = self._rounds = self._comparisons = 0
        self._take(views)
        self.fields = Fields(gaussians, self._units(gaussians.means), settings.sh_degree)
        self._densifier = self._make_densifier()

    @torch.no_grad()
    def add(self, views: Views) -> None:
        """Take more photographs, in the frame and the size of the first ones.

        Where no Gaussian covers what they show, those of a plane sweep of all are added; without
        room for them, those are left out that show the least.
        """
        views = views.validate("Refinement.add's views")
        check_device("Refinement.add", "views", views.images, "the first", self.background)
        self._take(self._given.join(views))
        self.motions.append(views.num_views)
        self._estimate = sweep(self.views)
        self.__dict__.pop("_known_depths", None)
        known, half = self.fields.gaussians(), max(1, self._max_gaussians // 2)
        limit = min(half, self.settings.initial_limit)
        found = initial_gaussians("plane_sweep", self.views, limit, estimate=self._estimate)
        found = found.keep(~is_covered(found.means, known, views.cameras))
        kept = self._max_gaussians - found.num_gaussians
        if kept < known.num_gaussians:
            shown = blending_weights(known, self.views.cameras, self.views.masks)
            self.fields.keep(shown.topk(kept).indices.sort().values)
        if found.num_gaussians:
            self.fields.append(found, self._units(found.means))
        self._densifier = self._make_densifier()

    def _take(self, views: Views) -> None:
        """Take views for the next steps, in a new order."""
        settings, self.views, self._given = self.settings, views, views
        size = (max(1, side // 2) for side in views.images.shape[-2:])
        self._half_views = views.resized(*size) if settings.half_resolution_until > 0 else views
        self._view_order = random_order(views.num_views, self._generator)
        self._blurred = []
        if settings.robust:
            found = find_blurred(views.images, views.cameras)
            self._blurred = torch.nonzero(found)[:, 0].tolist()
        self._max_gaussians = settings.limit(views.images[:, 0].numel())

    @cached_property
    def _known_depths(self) -> KnownDepths:
        return KnownDepths(self.views, self._estimate or sweep(self.views))

    @property
    def gaussians(self) -> Gaussians:
        """The current Gaussians, copied."""
        return self.fields.gaussians().map(lambda field: field.detach().clone())

    @property
    def num_gaussians(self) -> int:
        return len(self.fields)

    def advance(self, progress: float) -> Float[Tensor, ""]:
        """Densify where that is due, then take a step; see `step`."""
        settings, schedule = self.settings, self.settings.every
        if progress < settings.densify_until:
            due = rounds_until(self._steps, progress, settings)
            if due > self._rounds:
                self.densify(progress, due)
                self._rounds = due
            if schedule and self._steps and self._steps % schedule.opacity_reset == 0:
                self.reset_opacities()
        due = sum(progress > moment for moment in MOMENTS)
        if settings.robust and due > self._comparisons:
            found, self._comparisons = find_transients(self._differences()), due
            self.views = self._given if found is None else self._given.without(found)
        return self.step(progress)

    def step(self, progress: float) -> Float[Tensor, ""]:
        """Take a step at a progress in [0, 1]; return its mean squared error."""
        settings, views = self.settings, self._views(progress)
        leaves, cool_down = self.fields.leaves(), settings.cool_down
        # Not before the last densification, which removes what no step shows.
        last = max(1 - cool_down, settings.densify_until)
        left_out = self._blurred if progress > last else []
        order = (view for view in self._view_order if view not in left_out)
        all_views = views.num_views - len(left_out)
        chosen = list(islice(order, settings.views_per_step or all_views))
        # The factor of the rates: 1, then down to `final_lr_factor` over the cool-down.
        cooled = max(0.0, (progress - 1 + cool_down) / cool_down) if cool_down else 0
        factor = settings.final_lr_factor**cooled
        errors, sums = [], ()
        for view in chosen:
            target, background = self._before_background(views.one(view))
            mse, of_view = self._gradients(target, background, view, leaves, factor)
            self._densifier.observe_view(of_view[0], target.cameras)
            sums = list(map(torch.add, sums, of_view)) if sums else of_view
            errors.append(mse)
        gradients = dict(zip(leaves, sums, strict=True))
        every = settings.every
        degree = MAX_SH_DEGREE if every is None else self._steps // every.sh_degree
        means_alone = settings.decay_means_alone
        visible = self.fields.step(gradients, settings.rates, factor, means_alone, degree)
        self._densifier.observe_step(visible, factor)
        if settings.opacity_decay < 1 and progress < 1 - cool_down:
            self.fields.decay_opacities(settings.opacity_decay)
        self._steps += 1
        return errors[0] if len(errors) == 1 else torch.stack(errors).mean()

    def densify(self, progress: float, number: int = 1) -> None:
        """Prune, add or relocate Gaussians, by the settings' method; `number` counts the rounds."""
        count, remaining_rounds = len(self.fields), self.settings.densify_rounds - number + 1
        growth = (self._max_gaussians / count) ** (1 / max(1, remaining_rounds))
        self._densifier.densify(self._views(progress), round(count * growth))

    def _make_densifier(self) -> Densifier:
        schedule, both = self.settings.every, (self.fields, self._generator)
        if self.settings.densify == "error":
            return ErrorDensifier(*both, self.background, self._units)
        if self.settings.densify == "mcmc":
            return McmcDensifier(*both)
        if self.settings.densify == "gradient":
            first_reset = None if schedule is None else schedule.opacity_reset
            return CloneSplitDensifier(*both, self._max_gaussians, first_reset)
        return Densifier()

    def reset_opacities(self) -> None:
        """Lower all opacities, so that those that are not needed are pruned (Kerbl et al. 2023)."""
        self.fields.reset_opacities(MAX_RESET_OPACITY)

    def _before_background(self, view: Views) -> tuple[Views, Float[Tensor, "3"]]:
        """Return a view and what is behind it: for an object, in every other step a random color.

        Before one color alone, fog of that color would cost nothing around the object.
        """
        if view.alphas is None or self._steps % 2 == 0 or not self.settings.rates.opacities:
            return view, self.background
        color = torch.rand(3, generator=self._generator, device=view.images.device)
        return view.over(self.background, color), color

    @torch.enable_grad()  # as a prediction is often called without
    def _gradients(
        self,
        target: Views,
        background: Float[Tensor, "3"],
        view: int,
        leaves: Parameters,
        factor: float,
    ) -> tuple[Tensor, Sequence[Tensor]]:
        """Render a view and update its motion; return its MSE and the leaves' gradients."""
        cameras, motions = target.cameras, self.motions.leaves()
        for motion in motions:
            cameras = correct_poses(cameras, motion[view, None])
        gaussians = self.fields.gaussians(leaves)
        with_depth = self.settings.depth > 0 and factor == 1
        rendering = render(gaussians, cameras, background, depth=with_depth, masks=target.masks)
        image = rendering.image
        if self.settings.ssim is None:
            loss = F.mse_loss(target.masked(image), target.images)
        else:
            loss = image_loss(image, target.images, self.settings.ssim, target.masks).sum()
        if rendering.depth is not None:
            loss = loss + self.settings.depth * self._known_depths.error(rendering.depth, view)
        if self.settings.densify == "mcmc":
            loss = loss + mcmc_regularizer(gaussians)
        gradients = torch.autograd.grad(loss, [*leaves.values(), *motions])
        for gradient in gradients[len(leaves) :]:
            self.motions.step(view, gradient, factor)
        mse = F.mse_loss(target.masked(image.detach()), target.images)
        return mse, gradients[: len(leaves)]

    def _differences(self) -> Iterator[Float[Tensor, "1 3 H W"]]:
        gaussians = self.fields.gaussians()
        for row in range(self._given.num_views):
            view = self._given.one(row)
            cameras = view.cameras
            for motion in self.motions.leaves():
                cameras = correct_poses(cameras, motion[row, None])
            image = render(gaussians, cameras, self.background, masks=view.masks).image
            yield view.masked(image) - view.images

    def _views(self, progress: float) -> Views:
        return self._half_views if progress < self.settings.half_resolution_until else self.views

    def _units(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        if self.settings.rates.unit == "scene":
            return torch.ones_like(means[:, 0])
        return footprints(means, self.views.cameras)


def refine(
    gaussians: Gaussians,
    views: Views,
    settings: RefinementSettings = DEFAULT,
    *,
    seconds: float | int | None = None,
    steps: int | None = None,
    background: Float[Tensor, "3"] | None = None,
    seed: int = 0,
    estimate: DepthEstimate | None = None,
    watch: Callable[[RefinementProgress, Refinement], bool] | None = None,
) -> Gaussians:
    """Refine Gaussians for some seconds or steps, at most for the settings' `max_steps`.

    Of an object, whose views have alphas, those are left that lie in its visual hull. With `steps`,
    the same inputs and seed give the same bits on a CPU.

    Args:
        gaussians, views, background, settings, seed, estimate: see `Refinement`.
        seconds, steps: give one of them.
        watch: called after each step; ends the refinement if it returns True.

    Raises:
        InputError: neither seconds nor steps, or both; see `Refinement`.

    Example:
        >>> from asysplat import load, open_photographs, refine
        >>> views = open_photographs("my_scene", height=64, views=4).inputs
        >>> gaussians = refine(load("shipped")(views), views, steps=5)
    """
    budget = read_budget(seconds, steps)
    refinement = Refinement(gaussians, views, background, settings, seed, estimate)
    if seconds is not None:  # steps with few Gaussians compile the kernels before the time runs
        few, one_view = gaussians.map(lambda field: field[:10]), replace(settings, views_per_step=1)
        small = Refinement(few, views.select([0]), settings=one_view)
        small.step(0.0)
        small.step(1.0)
        small.densify(0.0)
    run_steps(refinement, budget, watch, settings.max_steps(views.num_views))
    refined = refinement.gaussians
    return refined if views.alphas is None else within_hull(refined, views)


def is_covered(
    points: Float[Tensor, "P 3"], gaussians: Gaussians, cameras: Cameras
) -> Bool[Tensor, "P"]:
    """Return whether Gaussians hide what is behind them wherever a camera shows a point."""
    covered = torch.ones_like(points[:, 0], dtype=torch.bool)
    for view in range(cameras.num_views):
        camera = cameras.select([view])
        (alpha,) = render(gaussians, camera, depth=False).alpha
        (pixels,), _, (inside,) = camera.project(points)
        x, y = pixels[inside].long().unbind(-1)
        covered[inside] &= alpha[y, x] > COVERED
    return covered


def without_unneeded(gaussians: Gaussians, inputs: Views) -> Gaussians:
    """Leave out the Gaussians that show least in the inputs, UNNEEDED of all blending weights.

    What no input shows, whose colors are guesses, is among them: where nothing else is, other views
    show the background. If the inputs show nothing, none is left out.
    """
    weights, order = blending_weights(gaussians, inputs.cameras, inputs.masks).double().sort()
    needed = torch.empty_like(order, dtype=torch.bool)
    needed[order] = weights.cumsum(0) > UNNEEDED * weights.sum()
    return gaussians.keep(needed) if needed.any() else gaussians


@dataclass(frozen=True)
class Budget:
    """So many steps, or seconds."""

    amount: float | int
    timed: bool  # seconds


def read_budget(seconds: float | int | None, steps: int | None) -> Budget:
    """Return the one that is given, or raise InputError."""
    given = {k: v for k, v in {"seconds": seconds, "steps": steps}.items() if v is not None}
    if len(given) != 1:
        raise InputError(f"seconds={seconds} and steps={steps}: give one of them.")
    check_options(given, {"seconds": Positive, "steps": Count})
    return Budget(*given.values(), timed=steps is None)


def run_steps(
    refinement: Refining,
    budget: Budget,
    watch: Callable[[RefinementProgress, Any], bool] | None,
    max_steps: float = math.inf,
) -> None:
    """Advance a refinement to the end of its budget, or for `max_steps`; see `refine`."""
    # One tensor: small ones of many steps, between large buffers, would fragment the memory.
    errors = torch.zeros(refinement.views.num_views, device=refinement.views.images.device)
    step, progress = 0, 0.0
    passed = 0.0
    while progress < 1:
        clock = time.perf_counter()
        errors[step % len(errors)] = refinement.advance(progress)
        passed += time.perf_counter() - clock
        step += 1
        used = (passed if budget.timed else step) / budget.amount
        progress = min(1.0, max(used, step / max_steps))
        count, latest = refinement.num_gaussians, errors[:step].clone()
        status = RefinementProgress(step, progress, passed, count, latest)
        if watch is not None and watch(status, refinement):
            break


def rounds_until(step: int, progress: float, settings: RefinementSettings) -> int:
    """Return the number of rounds of densification that are due by now."""
    if settings.every is None:
        return int(progress / settings.densify_until * (settings.densify_rounds + 1))
    return max(0, (step - settings.every.first_round) // settings.every.round + 1)
