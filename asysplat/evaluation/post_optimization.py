"""Measure a scene before and after steps of the paper's post-optimization: images and costs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.evaluation.measured_cost import CostMeter
from asysplat.evaluation.metrics import ImageRow
from asysplat.evaluation.protocol import Protocol
from asysplat.evaluation.view_images import ViewImages
from asysplat.refinement import PAPER, AnchorScene, Refinement, RefinementProgress, refine
from asysplat.rendering import Rendering, render
from asysplat.scene import Gaussians, Views

POST_OPTIMIZATION_METHOD = (
    "each step renders all input views from the Gaussians and takes a step of Adam on their mean "
    f"squared error, with learning rates {PAPER.rates.means:g} of means (the farthest input camera "
    f"is at distance 1 from the middle of all) and {PAPER.rates.sh:g} of SH, 0 of the others; "
    "seconds and gb are those of the prediction and the steps together"
)
Scene = Gaussians | AnchorScene | ViewImages
Predict = Callable[[Views], Scene]
StepCallback = Callable[[int, Rendering | None], None]


@dataclass
class SceneResult:
    """The measurements of one scene."""

    scene: str  # its name
    gaussians: int = 0  # their number
    # "post<steps>" -> the seconds of the prediction and that many steps together and, where it can
    # be measured, their peak memory, gb.
    costs: dict[str, dict[str, float]] = field(default_factory=dict)
    # A row for each image: `images` (targets or inputs), `view`, `method` (post<steps> or a
    # baseline) and its metrics.
    rows: list[ImageRow] = field(default_factory=list)

    def add(self, images: str, method: str, rows: Sequence[dict[str, float]]) -> None:
        """Add a row of metrics for each view."""
        for view, row in enumerate(rows):
            self.rows.append({"images": images, "view": view, "method": method} | row)


@dataclass(frozen=True)
class PostOptimization:
    """Runs the paper's post-optimization (Suppl. A) on scenes and measures them at given steps.

    The input views are rendered from the predicted Gaussians; their mean squared error optimizes
    means and SH, all views in each step. Scenes of other kinds are measured as they are.
    """

    steps: Sequence[int]  # after which to measure, increasing; 0: as predicted
    protocol: Protocol
    lpips: nn.Module | None
    # None: what is behind an object in the inputs, else their mean color.
    background: Float[Tensor, "3"] | None = None
    # By the names of scenes of which another one is known.
    backgrounds: Mapping[str, Float[Tensor, "3"]] = field(default_factory=dict)

    def __post_init__(self):
        valid = all(type(step) is int and step >= 0 for step in self.steps)
        if not self.steps or not valid or list(self.steps) != sorted(set(self.steps)):
            raise InputError(
                f"post_optimization_steps={self.steps}: give whole numbers from 0 on, each above "
                "the one before, such as [0,3,10]."
            )

    def __call__(
        self,
        scene: str,
        predict: Predict,
        inputs: Views,
        targets: Views,
        watch: StepCallback = lambda step, rendering: None,
    ) -> SceneResult:
        """Measure one scene, without batch dimension; the costs do not include the metrics.

        Transparent pixels of its views show the background that it is measured before.

        `watch` is called after each step with the number of steps and, at the steps to measure, the
        rendering of the targets.
        """
        inputs, targets, background = self._before_background(scene, inputs, targets)
        result = SceneResult(scene)
        for method, rows in self.protocol.measure_baselines(inputs, targets, self.lpips).items():
            result.add("targets", method, rows)
        meter = CostMeter(inputs.images.device)

        def measure(step: int, predicted: Scene) -> None:
            meter.stop()
            method = f"post{step}"
            result.costs[method] = {"seconds": sum(meter.seconds)}
            if meter.gb:
                result.costs[method]["gb"] = max(meter.gb)
            rendering = _render(predicted, targets, background)
            drawn = rendering.image, rendering.depth
            result.add("targets", method, self.protocol.measure_views(*drawn, targets, self.lpips))
            if not isinstance(predicted, ViewImages):
                images = _render(predicted, inputs, background).image
                rows = self.protocol.measure_views(images, None, inputs, None, psnr_only=True)
                result.add("inputs", method, rows)
                result.gaussians = predicted.num_gaussians
            watch(step, rendering)
            meter.start()

        def after_step(progress: RefinementProgress, refinement: Refinement) -> bool:
            if progress.step in self.steps:
                measure(progress.step, refinement.gaussians)
            else:
                watch(progress.step, None)
            return False

        meter.start()
        predicted = predict(inputs)
        if 0 in self.steps:
            measure(0, predicted)
        if (steps := self.steps[-1]) > 0:
            if not isinstance(predicted, Gaussians):
                raise InputError(
                    f"post_optimization_steps={self.steps}: only Gaussians that are the same in "
                    "every view are optimized: give post_optimization_steps=0."
                )
            refine(predicted, inputs, PAPER, steps=steps, background=background, watch=after_step)
        return result

    def draw(
        self, scene: str, predict: Predict, inputs: Views, targets: Views
    ) -> tuple[Views, Views, Rendering]:
        """Return the views as they are measured, and the targets as rendered without any step."""
        inputs, targets, background = self._before_background(scene, inputs, targets)
        return inputs, targets, _render(predict(inputs), targets, background)

    def _before_background(
        self, scene: str, inputs: Views, targets: Views
    ) -> tuple[Views, Views, Float[Tensor, "3"]]:
        """Return the views before the background that the scene is measured on, and its color."""
        behind = inputs.color_behind(inputs.mean_color())
        known = self.backgrounds.get(scene, self.background)
        background = behind if known is None else known
        return inputs.over(behind, background), targets.over(behind, background), background


@torch.no_grad()
def _render(scene: Scene, views: Views, background: Float[Tensor, "3"]) -> Rendering:
    if isinstance(scene, Gaussians):
        return render(scene, views.cameras, background, masks=views.masks)
    return scene.render(views.cameras, background, views.masks)
