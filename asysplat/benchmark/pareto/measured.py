"""All settings of a family on one scene: seconds, memory, error, metrics."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial

import torch
from lpips import LPIPS
from omegaconf import DictConfig
from torch import Tensor

from asysplat.benchmark.pareto.scenes import PosedScene
from asysplat.benchmark.pareto.settings import BASE, CPU, Draw, Refined, Setting
from asysplat.benchmark.timing import (
    Measurement,
    Result,
    rise_gb,
    seconds_of,
    summary,
    time_in_rounds,
)
from asysplat.errors import InputError
from asysplat.evaluation.protocol import Protocol

LEAST_ERROR = 1e-20  # squared, of pictures that are the same: 200 dB, as JSON has no infinity


@dataclass(frozen=True)
class Meter:
    """How settings are measured on every scene.

    Args:
        protocol: of the metrics.
        lpips: see `load_lpips`; None for no LPIPS.
        refinement: a file of conf/refinement.
        device: where networks predict; refinements are on the CPU.
        repeats: timed rounds.
    """

    protocol: Protocol
    lpips: LPIPS | None
    refinement: DictConfig
    device: torch.device
    repeats: int

    def prepare(self, settings: Mapping[str, Setting]) -> dict[str, Draw]:
        """Load what each setting draws with.

        Raises:
            InputError: a setting that cannot be, or without weights.
        """
        return {n: each.prepare(self.refinement, self.device) for n, each in settings.items()}

    def rows(
        self, scene: PosedScene, settings: Mapping[str, Setting], draws: Mapping[str, Draw]
    ) -> list[Result]:
        """Measure all settings in turns; a row for each.

        Raises:
            InputError: the setting BASE cannot draw this scene. Of another that cannot, all
                numbers are None, and "not_measured" says why.
        """
        refined = isinstance(settings[BASE], Refined)
        device = CPU if refined else self.device
        scene = PosedScene(scene.name, scene.inputs.to(device), scene.targets.to(device))
        pictures: dict[str, Tensor] = {}
        timed: dict[str, Measurement] = {}
        absent: dict[str, str] = {}

        def run(name: str) -> None:
            pictures[name] = draws[name](scene)

        for name in settings:
            try:
                found = {"peak_gb": max(0.0, rise_gb(partial(run, name), device))}
            except InputError as error:
                if name == BASE:
                    raise
                absent[name] = str(error)
                continue
            timed[name] = Measurement(partial(_seconds, partial(run, name), device), found)
        time_in_rounds(list(timed.values()), self.repeats)
        truths = self._truths(scene, settings, pictures)
        return [
            {"setting": name, "values": asdict(setting), "not_measured": absent.get(name)}
            | self._numbers(timed.get(name), timed[BASE])
            | self._quality(scene, setting, pictures.get(name), truths.get(name))
            for name, setting in settings.items()
        ]

    def _truths(
        self, scene: PosedScene, settings: Mapping[str, Setting], pictures: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Draw what each setting's pictures are compared with; a setting that is it has none."""
        drawn: list[tuple[Setting, Tensor]] = [(settings[BASE], pictures[BASE])]
        truths = {}
        for name in pictures:
            exact = settings[name].exact(settings[BASE])
            if exact == settings[name]:
                continue
            if exact not in [setting for setting, _ in drawn]:
                drawn.append((exact, exact.prepare(self.refinement, self.device)(scene)))
            truths[name] = next(picture for setting, picture in drawn if setting == exact)
        return truths

    @staticmethod
    def _numbers(timed: Measurement | None, base: Measurement) -> Result:
        if timed is None:
            return dict.fromkeys(("seconds", "over_base", "peak_gb"))
        pairs = zip(timed.seconds["seconds"], base.seconds["seconds"], strict=True)
        over_base = summary([own / of_base for own, of_base in pairs])
        return {"seconds": timed.summary("seconds"), "over_base": over_base} | timed.found

    def _quality(
        self, scene: PosedScene, setting: Setting, picture: Tensor | None, truth: Tensor | None
    ) -> Result:
        found = dict.fromkeys(("error", "psnr", "ssim", "lpips"))
        if picture is not None and truth is not None:
            found["error"] = picture_error(picture, truth)
        if picture is not None and setting.trained:
            metrics = self.protocol.image_metrics(picture, scene.targets, self.lpips)
            found |= {name: values.mean().item() for name, values in metrics.items()}
        return found


def picture_error(picture: Tensor, truth: Tensor) -> Result:
    """Compare pictures, clamped to [0, 1]: decibels of the mean squared error, and the largest."""
    wrong = picture.double().clamp(0, 1) - truth.double().clamp(0, 1)
    squared = wrong.square().mean().clamp_min(LEAST_ERROR)
    return {"decibels": -10 * squared.log10().item(), "max": wrong.abs().max().item()}


def _seconds(run: partial, device: torch.device) -> dict[str, float]:
    return {"seconds": seconds_of(run, device)}
