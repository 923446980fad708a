"""One scene: what a start, a refinement and no reconstruction at all are worth."""

import math
import time

import torch
from lpips import LPIPS

from asysplat.benchmark.render.run import Backend, prepare, run
from asysplat.benchmark.timing import Measurement, Result, seconds_of, time_in_rounds
from asysplat.evaluation.baselines import mean_color_images
from asysplat.evaluation.baselines import nearest_view_images
from asysplat.evaluation.protocol import Protocol
from asysplat.evaluation.scene import measure_scene
from asysplat.models.network import Network
from asysplat.refinement import (
    Refinement,
    RefinementProgress,
    RefinementSettings,
    mean_color,
    refine,
)
from asysplat.refinement.init import initial_gaussians
from asysplat.refinement.photographs import Photographs
from asysplat.rendering import Culling
from asysplat.scene import Gaussians, Views

NEAREST = "nearest view"
FOR_NOTHING = {NEAREST: nearest_view_images, "mean color": mean_color_images}
SEED = 0
FIRST_LOOK, LATER = (
    1.0,
    2**0.5,
)  # seconds of refinement until the first look; so many times, the next
CPU = torch.device("cpu")  # which refines


class MeasuredScene:
    """The photographs of a scene, and how those held out are measured.

    Args:
        photographs: some of them are held out.
        protocol: of the metrics.
        lpips: see `load_lpips`; None for no LPIPS.
    """

    def __init__(self, photographs: Photographs, protocol: Protocol, lpips: LPIPS | None):
        self.photographs, self._protocol, self._lpips = photographs, protocol, lpips
        self._background = mean_color(photographs.inputs)

    def for_nothing(self) -> list[Result]:
        """Measure what one gets without a reconstruction: a row for each of FOR_NOTHING."""
        inputs, targets = self.photographs.inputs, self.photographs.measured
        rows = []
        for name, draw in FOR_NOTHING.items():
            found = self._protocol.image_metrics(draw(inputs, targets), targets, self._lpips)
            rows.append({"variant": name} | _means({k: v.tolist() for k, v in found.items()}))
        return rows

    def start(
        self, init: str, most: int, network: Network | None = None
    ) -> tuple[Gaussians, Result]:
        """Make the Gaussians that a refinement starts from, and measure them.

        They are made twice, of which the second counts: kernels are compiled when first used.

        Args:
            init, most, network: see `initial_gaussians`.

        Returns:
            The Gaussians; their number, the metrics, and "start": seconds until they were made.

        Raises:
            InputError: the photographs lack what `init` needs.
        """
        initial_gaussians(init, self.photographs, most, network)
        clock = time.perf_counter()
        gaussians = initial_gaussians(init, self.photographs, most, network)
        seconds = time.perf_counter() - clock
        return gaussians, {"start": seconds} | self._measured(gaussians)

    def refined(
        self, gaussians: Gaussians, settings: RefinementSettings, repeats: int, **limit: float | int
    ) -> Result:
        """Refine Gaussians, then measure them: no measurement takes of the refinement's time.

        Args:
            gaussians: [N], to start from.
            settings: of the refinement.
            repeats: rounds in which a step is compared with the renderer.
            limit: seconds or steps, see `refine`.

        Returns:
            "steps", "seconds_a_step" over the whole refinement, the number of Gaussians and the
            metrics at its end; "curve": seconds and PSNR on the way, which is measured later;
            "step", "renderer" and "over_renderer", see `step_and_renderer`.
        """
        last: list[RefinementProgress] = []
        looks: list[tuple[float, Gaussians]] = []

        def watch(now: RefinementProgress, refinement: Refinement) -> bool:
            last[:] = [now]
            if now.seconds >= FIRST_LOOK * LATER ** len(looks):
                looks.append((now.seconds, refinement.gaussians))
            return False

        inputs = self.photographs.inputs
        gaussians = refine(
            gaussians,
            inputs,
            settings,
            background=self._background,
            seed=SEED,
            watch=watch,
            **limit,
        )
        (end,) = last
        found = {"steps": end.step, "seconds_a_step": end.seconds / end.step}
        found["curve"] = [(seconds, self._psnr(then)) for seconds, then in looks]
        view = inputs.select([inputs.num_views // 2])
        return (
            found
            | self._measured(gaussians)
            | step_and_renderer(gaussians, view, settings, repeats)
        )

    def _psnr(self, gaussians: Gaussians) -> float:
        views = self.photographs.measured
        found = measure_scene(gaussians, views, self._background, self._protocol, None)
        return _means(found)["psnr"]

    def _measured(self, gaussians: Gaussians) -> Result:
        views = self.photographs.measured
        found = measure_scene(gaussians, views, self._background, self._protocol, self._lpips)
        return {"gaussians": gaussians.num_gaussians} | _means(found)


def step_and_renderer(
    gaussians: Gaussians, view: Views, settings: RefinementSettings, repeats: int
) -> Result:
    """Compare a step of a refinement with the renderer, on the same Gaussians and view, in turns.

    Args:
        gaussians: [N].
        view: one photograph.
        settings: of the refinement, which is at its end.
        repeats: rounds.

    Returns:
        "step": seconds of one; "renderer": those of its forward and backward pass alone; both with
        median and interquartile range; "over_renderer": the first over the second.
    """
    refinement = Refinement(gaussians, view, settings=settings)
    inputs = prepare((gaussians, view.cameras), "cpu")
    renderer = Backend("cpu", "cpu")

    def seconds() -> dict[str, float]:
        return {
            "step": seconds_of(lambda: refinement.step(1.0), CPU),
            "renderer": sum(run(renderer, Culling(), inputs).seconds.values()),
        }

    timed = Measurement(seconds)
    time_in_rounds([timed], repeats)
    found = {name: timed.summary(name) for name in ("step", "renderer")}
    return found | {"over_renderer": found["step"]["median"] / found["renderer"]["median"]}


def _means(found: dict[str, list[float]]) -> Result:
    """Return the means over the views that have a number; None where none has."""
    means = {name: torch.tensor(values).nanmean().item() for name, values in found.items()}
    return {name: value if math.isfinite(value) else None for name, value in means.items()}
