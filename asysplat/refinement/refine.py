"""Fit a scene's Gaussians to its photographs: per-scene optimization from a good start.

The paper's post-optimization is one setting of it, `PAPER`.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.image_loss import image_loss
from asysplat.refinement.clone_split import Pulls
from asysplat.refinement.corrections import Corrections, exposed, moved_cameras
from asysplat.refinement.densify import LEAST_OPACITY, gaussians_where_wrong, look
from asysplat.refinement.fields import Fields, Numbers
from asysplat.refinement.relocate import regularizer, relocate, shake
from asysplat.refinement.settings import RefinementSettings
from asysplat.refinement.start import footprints
from asysplat.rendering import render
from asysplat.scene import Gaussians, Views

PIXELS_EACH = 8  # of the photographs, at least, for each Gaussian: with fewer they learn noise
VIEWS_A_ROUND = 8  # in which wrong pixels are looked for


@dataclass(frozen=True)
class RefinementProgress:
    """How far a refinement is.

    Args:
        step: steps that were taken.
        share: of the refinement, in [0, 1].
        seconds: since it began.
        psnr: of the photographs, each before the step that it was looked at, in dB: mean of the
            last ones.
        gaussians: how many there are.
    """

    step: int
    share: float
    seconds: float
    psnr: float
    gaussians: int


class Refinement:
    """Gaussians, the photographs they are fitted to, and a step.

    Args:
        gaussians: [N], to start from.
        views: the photographs, [V].
        background: behind all; the mean color of the photographs where it is None.
        settings: see `RefinementSettings`.
        seed: of the order of the photographs and of new Gaussians.

    Raises:
        InputError: no Gaussians, or values that cannot be used.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Views,
        background: Float[Tensor, "3"] | None = None,
        settings: RefinementSettings = RefinementSettings(),  # noqa: B008
        seed: int = 0,
    ):
        if gaussians.num_gaussians == 0:
            raise InputError("refine got no Gaussians: start from at least one.")
        gaussians.validate("refine's gaussians")
        self.views = views.validate("refine's views")
        self.settings = settings
        self.background = mean_color(views) if background is None else background
        self._generator = torch.Generator().manual_seed(seed)
        self.fields = Fields(gaussians, self._units(gaussians.means), settings.sh_degree)
        self.corrections = Corrections(views.num_views, settings.rates)
        self._half = half_size(views) if settings.half_size > 0 else views
        self._queue: list[int] = []
        self._steps = 0
        self._last_seen = views.images.new_zeros(len(self.fields), dtype=torch.long)
        self._pulls = Pulls(self.fields) if settings.densify == "gradient" else None
        self._room = min(settings.most, views.images[:, 0].numel() // PIXELS_EACH)

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now, copied."""
        return self.fields.gaussians().map(lambda field: field.detach().clone())

    def step(self, share: float) -> float:
        """Take a step; return the mean squared error of the photographs that it looked at.

        Args:
            share: of the refinement that has passed, in [0, 1].
        """
        settings = self.settings
        views = self._half if share < settings.half_size else self.views
        chosen = self._next(settings.views_a_step or self.views.num_views)
        leaves, factor = self.fields.leaves(), self._factor(share)
        error, gradients = 0.0, {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
        for view in chosen:
            mse, found = self._gradients(views.select([view]), view, leaves, factor)
            if self._pulls is not None:
                self._pulls.add(found[0], views.cameras.select([view]))
            for name, gradient in zip(leaves, found, strict=True):
                gradients[name] = gradient if len(chosen) == 1 else gradients[name] + gradient
            error += mse / len(chosen)
        seen = self.fields.step(gradients, settings.rates, factor)
        if settings.densify == "mcmc":
            shake(self.fields, factor, self._generator)
        self._steps += 1
        self._last_seen[seen] = self._steps
        return error

    def densify(self, share: float) -> None:
        """Drop Gaussians that are of no use, and add some where pixels are wrong.

        Args:
            share: of the refinement that has passed, in [0, 1].
        """
        settings = self.settings
        if settings.densify == "error":
            self._densify_where_wrong(share)
            return
        if settings.densify == "mcmc":
            relocate(self.fields, self._room, settings.growth, self._generator)
        elif self._pulls is not None:
            self._pulls.clone_and_split(self._room, self._generator)
        self._last_seen = self._last_seen.new_full((len(self.fields),), self._steps)

    def _densify_where_wrong(self, share: float) -> None:
        settings = self.settings
        views = self._half if share < settings.half_size else self.views
        opacities = self.fields.numbers["logits"].detach().sigmoid()
        # Seen by none of the photographs, all of which have come twice.
        lost = self._steps - self._last_seen > 2 * views.num_views
        useful = (opacities > LEAST_OPACITY) & ~lost
        useful[opacities.argmax()] = True  # one is left
        most = min(self._room, int((1 + settings.growth) * len(self.fields)))
        kept = torch.nonzero(useful)[:, 0]
        self.fields.keep(kept)
        self._last_seen = self._last_seen[kept]
        count = most - len(self.fields)
        if count > 0:
            order = torch.randperm(views.num_views, generator=self._generator)
            some = views.select(order[:VIEWS_A_ROUND])
            seen = look(self.gaussians, some, self.background)
            new = gaussians_where_wrong(some, *seen, count, self._generator)
            self.fields.append(new, self._units(new.means))
            now = self._last_seen.new_full((new.num_gaussians,), self._steps)
            self._last_seen = torch.cat((self._last_seen, now))

    def _gradients(
        self, target: Views, view: int, leaves: Numbers, factor: float
    ) -> tuple[float, Sequence[Tensor]]:
        """Render a photograph; return its squared error and the gradients of the leaves.

        What the photograph itself is forgiven is corrected at once.
        """
        cameras, forgiven = target.cameras, {}
        if self.corrections.wanted:
            forgiven = self.corrections.leaves(view)
            cameras = moved_cameras(cameras, forgiven["poses"])
        gaussians = self.fields.gaussians(leaves)
        image = render(gaussians, cameras, self.background, depth=False, masks=target.masks).image
        if forgiven:
            image = exposed(image, forgiven["exposure"])
        loss = self._loss(image, target)
        if self.settings.densify == "mcmc":
            loss = loss + regularizer(gaussians)
        found = torch.autograd.grad(loss, [*leaves.values(), *forgiven.values()])
        if forgiven:
            own = dict(zip(forgiven, found[len(leaves) :], strict=True))
            self.corrections.step(view, own, factor)
        mse = F.mse_loss(target.masked(image.detach()), target.images).item()
        return mse, found[: len(leaves)]

    def _loss(self, image: Float[Tensor, "1 3 H W"], target: Views) -> Tensor:
        if self.settings.ssim is None:
            return F.mse_loss(target.masked(image), target.images)
        return image_loss(image, target.images, self.settings.ssim, target.masks).sum()

    def _factor(self, share: float) -> float:
        """Return the factor of all rates: 1, then down to `decay` over the cool-down."""
        cool_down = self.settings.cool_down
        if cool_down == 0:
            return 1.0
        return self.settings.decay ** max(0.0, (share - 1 + cool_down) / cool_down)

    def _next(self, count: int) -> list[int]:
        """Return the next photographs: all of them come before one comes again."""
        while len(self._queue) < count:
            self._queue += torch.randperm(self.views.num_views, generator=self._generator).tolist()
        chosen, self._queue = self._queue[:count], self._queue[count:]
        return chosen

    def _units(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        if self.settings.rates.unit == "scene":
            return torch.ones_like(means[:, 0])
        return footprints(means, self.views.cameras)


def refine(
    gaussians: Gaussians,
    views: Views,
    settings: RefinementSettings = RefinementSettings(),  # noqa: B008
    *,
    seconds: float | int | None = None,
    steps: int | None = None,
    background: Float[Tensor, "3"] | None = None,
    seed: int = 0,
    watch: Callable[[RefinementProgress, Refinement], bool] | None = None,
) -> Gaussians:
    """Refine Gaussians until the seconds or the steps are used, or more would fit noise.

    With `steps`, the same inputs and seed give the same bits.

    Args:
        gaussians, views, background, settings, seed: see `Refinement`.
        seconds, steps: give one of them.
        watch: called after each step; True ends the refinement.

    Raises:
        InputError: neither seconds nor steps, or both; see `Refinement`.
    """
    if (seconds is None) == (steps is None) or not (steps if seconds is None else seconds) > 0:
        raise InputError(f"refine got seconds={seconds} and steps={steps}: give one, above 0.")
    refinement = Refinement(gaussians, views, background, settings, seed)
    if seconds is not None:
        _compile_kernels(gaussians, views, settings)
    most = settings.most_steps(views.num_views)
    errors: deque[float] = deque(maxlen=views.num_views)  # the last at each photograph
    step, rounds, share = 0, 0, 0.0
    clock = time.perf_counter()
    while share < 1:
        if settings.densify != "none" and share < settings.until:
            due = int(share / settings.until * (settings.rounds + 1))
            if due > rounds:
                refinement.densify(share)
                rounds = due
        errors.append(refinement.step(share))
        step += 1
        passed = time.perf_counter() - clock
        used = step / steps if seconds is None else passed / seconds
        share = min(1.0, max(used, step / most))
        psnr = -10 * math.log10(max(sum(errors) / len(errors), 1e-10))
        progress = RefinementProgress(step, share, passed, psnr, len(refinement.fields))
        if watch is not None and watch(progress, refinement):
            break
    return refinement.gaussians


def _compile_kernels(gaussians: Gaussians, views: Views, settings: RefinementSettings) -> None:
    """Take steps with few Gaussians, so that compiling kernels, once, takes none of the time."""
    few = gaussians.map(lambda field: field[:10])
    small = Refinement(few, views.select([0]), settings=replace(settings, views_a_step=1))
    small.step(0.0)
    small.densify(0.0)


def mean_color(views: Views) -> Float[Tensor, "3"]:
    """Return the mean color of the pixels of photographs that count; gray where none does."""
    colors = views.images.movedim(-3, -1)
    if views.masks is not None:
        colors = colors[views.masks]
    return colors.flatten(0, -2).mean(0).nan_to_num(0.5)


def half_size(views: Views) -> Views:
    """Return the views with half as many pixels along each side."""
    height, width = max(1, views.cameras.height // 2), max(1, views.cameras.width // 2)
    masks = views.masks
    if masks is not None:
        kept = F.interpolate(masks[:, None].float(), (height, width), mode="area")
        masks = kept[:, 0] == 1
    return Views(
        views.cameras.resized(height, width),
        F.interpolate(views.images, (height, width), mode="area"),
        masks=masks,
    )
