"""A scene before and after steps of the paper's post-optimization: its images and its costs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from lpips import LPIPS
from torch import Tensor

from asysplat.errors import InputError
from asysplat.evaluation.baselines import mean_color, nearest_view
from asysplat.evaluation.measured_cost import CostMeter
from asysplat.evaluation.protocol import Protocol
from asysplat.evaluation.rows import ImageRow
from asysplat.refinement import PAPER, Refinement, RefinementProgress, refine
from asysplat.rendering import Rendering, render
from asysplat.scene import Gaussians, Views

HOW = (
    "each step renders all input views from the Gaussians and takes a step of Adam on their mean "
    f"squared error, with learning rates {PAPER.rates.means:g} of means (the farthest input camera "
    f"is at distance 1 from the middle of all) and {PAPER.rates.sh:g} of SH, 0 of the others; "
    "seconds and gb are those of the prediction and the steps together"
)
Predict = Callable[[Views], Gaussians]
Watch = Callable[[int, Rendering | None], None]


@dataclass
class SceneResult:
    """What was measured of one scene.

    Args:
        scene: its name.
        gaussians: how many there are.
        costs: "post<steps>" -> the seconds of the prediction and so many steps together and, where
            it can be measured, their peak memory, gb.
        rows: one for each image, with `images` (targets or inputs), `view`, `source` (what drew it:
            post<steps>, nearest_view or mean_color) and its metrics.
        skipped: the shares that its prediction left out, see `Network`.
    """

    scene: str
    gaussians: int = 0
    costs: dict[str, dict[str, float]] = field(default_factory=dict)
    rows: list[ImageRow] = field(default_factory=list)
    skipped: dict[str, float] = field(default_factory=dict)

    def add(self, images: str, source: str, values: dict[str, Float[Tensor, "V"]]) -> None:
        """Add a row for each view; `values` has one or more metrics."""
        for view in range(len(next(iter(values.values())))):
            numbers = {name: value[view].item() for name, value in values.items()}
            self.rows.append({"images": images, "view": view, "source": source, **numbers})


@dataclass(frozen=True)
class PostOptimization:
    """Post-optimizes scenes as the paper does (Suppl. A) and measures them on the way.

    The input views are rendered from the predicted Gaussians; their mean squared error moves means
    and SH, all views in each step.

    Args:
        steps: after which to measure, increasing; 0: as predicted.
        protocol: how images are measured.
        lpips: as for `Protocol.image_metrics`.
        background: RGB in [0, 1] behind the Gaussians; None: the mean color of the inputs.

    Raises:
        InputError: steps that are not whole numbers from 0 on, each above the one before.
    """

    steps: Sequence[int]
    protocol: Protocol
    lpips: LPIPS | None
    background: Float[Tensor, "3"] | None = None

    def __post_init__(self):
        whole = all(type(step) is int and step >= 0 for step in self.steps)
        if not self.steps or not whole or list(self.steps) != sorted(set(self.steps)):
            raise InputError(
                f"steps={self.steps}: give whole numbers from 0 on, each above the one before, "
                "such as [0,3,10]."
            )

    def __call__(
        self,
        scene: str,
        predict: Predict,
        inputs: Views,
        targets: Views,
        watch: Watch = lambda step, rendering: None,
    ) -> SceneResult:
        """Measure one scene; its costs leave out what measuring takes.

        Args:
            scene: its name.
            predict: the input views -> [N] Gaussians in their frame.
            inputs, targets: the scene's views, without a batch dimension.
            watch: called after each step, and where the scene is measured: with the number of
                steps, and there with the rendering of the targets.
        """
        background = self.background
        if background is None:
            background = inputs.images.mean((0, 2, 3))
        result = SceneResult(scene)
        for source in (nearest_view, mean_color):
            metrics = self.protocol.image_metrics(source(inputs, targets), targets, self.lpips)
            result.add("targets", source.__name__, metrics)
        meter = CostMeter(inputs.images.device)

        def measure(step: int, gaussians: Gaussians) -> None:
            meter.stop()
            source = f"post{step}"
            result.costs[source] = {"seconds": sum(meter.seconds)}
            if meter.gb:
                result.costs[source]["gb"] = max(meter.gb)
            rendering = _draw(gaussians, targets, background)
            metrics = self.protocol.image_metrics(rendering.image, targets, self.lpips)
            metrics |= self.protocol.depth_metrics(rendering.depth, targets)
            result.add("targets", source, metrics)
            shown = _draw(gaussians, inputs, background).image
            result.add("inputs", source, {"psnr": self.protocol.psnr(shown, inputs)})
            result.gaussians = gaussians.num_gaussians
            watch(step, rendering)
            meter.start()

        def look(progress: RefinementProgress, refinement: Refinement) -> bool:
            if progress.step in self.steps:
                measure(progress.step, refinement.gaussians)
            else:
                watch(progress.step, None)
            return False

        meter.start()
        gaussians = predict(inputs)
        if 0 in self.steps:
            measure(0, gaussians)
        if self.steps[-1] > 0:
            refine(
                gaussians,
                inputs,
                PAPER,
                steps=self.steps[-1],
                background=background,
                watch=look,
            )
        return result


@torch.no_grad()
def _draw(gaussians: Gaussians, views: Views, background: Float[Tensor, "3"]) -> Rendering:
    return render(gaussians, views.cameras, background, masks=views.masks)
