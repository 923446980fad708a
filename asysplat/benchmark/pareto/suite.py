"""Run time against error: every knob of a prediction and of a refinement, one at a time."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from asysplat.benchmark.compare import DECIBELS, LPIPS_DISTANCE, TIME, Watched
from asysplat.benchmark.options import check_names, find_device
from asysplat.benchmark.pareto.measured import Meter
from asysplat.benchmark.pareto.scenes import find_scenes
from asysplat.benchmark.pareto.settings import BASE, FAMILIES, Setting, find_settings
from asysplat.benchmark.pareto.shown import plot, summarize, tables
from asysplat.benchmark.timing import Result
from asysplat.evaluation.lpips import load_lpips

ALL = "all"
WATCHED = Watched(
    names=("family", "scene", "setting"),
    alike=("side", "values"),
    kinds={
        "seconds": TIME,
        "error.decibels": replace(DECIBELS, least=1.0),
        "psnr": DECIBELS,
        "lpips": LPIPS_DISTANCE,
    },
)

__all__ = ["WATCHED", "measure", "plot", "tables"]


def measure(options: DictConfig, console: Console) -> Result:
    """Draw the test views of `options.pareto.scenes` with every knob, `options.repeats` times.

    From photographs in memory to all test views: by a network's prediction ("feed_forward"), by
    untrained networks of other layers ("networks"), and by a refinement ("refined"). All settings
    of a family take turns on a scene.

    Returns:
        "rows": one for each family, scene and setting: "seconds", their ratio to the base's of the
        same round "over_base", "peak_gb" above what was held before, "error" of the pictures
        against the exact ones ("decibels", "max"), and "psnr", "ssim" and "lpips" against the
        photographs; None for what was not measured. "settings": the means over scenes, see
        `summarize`. "not_measured": what, and why.

    Raises:
        InputError: an unknown family, scene or knob, or one out of range.
    """
    wanted = OmegaConf.to_container(options.pareto, resolve=True)
    shared, side = Path(wanted["shared"]), wanted["side"]
    say = partial(console.print, markup=False, highlight=False, soft_wrap=True)
    families = find_families(wanted)
    protocol = instantiate(options.metrics)
    lpips = load_lpips(protocol.lpips_net, shared / "weights")
    device = find_device(options.device)
    meter = Meter(protocol, lpips, options.refinement, device, options.repeats)
    draws = {family: meter.prepare(settings) for family, settings in families.items()}
    scenes, absent = find_scenes(wanted["scenes"], shared / "data", side)
    if lpips is None:
        absent["LPIPS"] = f"{shared / 'weights'} has no weights of its backbone"
    if not torch.cuda.is_available():
        absent["a GPU"] = "there is none"
    rows: list[Result] = []
    for name, open_scene in scenes.items():
        scene = open_scene()
        for family, settings in families.items():
            if name in (wanted[family]["scenes"] or scenes):
                with console.status(f"{name}: {len(settings)} settings, {family}"):
                    found = meter.rows(scene, settings, draws[family])
                say(f"{name}: {family}, {len(found)} settings")
                rows += [{"family": family, "scene": name, "side": side} | row for row in found]
    absent |= {
        "{family}, {scene}, {setting}".format(**row): row["not_measured"]
        for row in rows
        if row["not_measured"]
    }
    return {
        "protocol": protocol.sentences(),
        "not_measured": absent,
        "rows": rows,
        "settings": summarize(rows),
    }


def find_families(wanted: Mapping[str, Any]) -> dict[str, dict[str, Setting]]:
    """Return the settings of each family that is wanted: the base, and the knobs that are.

    Raises:
        InputError: an unknown family or knob, or one out of range.
    """
    check_names("pareto.families", wanted["families"], FAMILIES)
    found = {
        family: find_settings(family, wanted[family]["base"], wanted[family]["knobs"] or {})
        for family in wanted["families"]
    }
    if wanted["knobs"] == ALL:
        return found
    every = dict.fromkeys(name for settings in found.values() for name in settings)
    check_names("pareto.knobs", wanted["knobs"], [*every, ALL])
    return {
        family: {n: setting for n, setting in settings.items() if n in (BASE, *wanted["knobs"])}
        for family, settings in found.items()
    }
