"""Turn photographs into a scene of Gaussians that opens everywhere.

python reconstruct.py my_scene
"""

import math
import os
import signal
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read with torch: idle threads must not spin

from omegaconf import DictConfig, OmegaConf

from asysplat.cli import check_command, command, exit_with_message
from asysplat.files import check_exists
from asysplat.interrupts import interrupt_once
from asysplat.overrides import path_option, split_paths

if __name__ == "__main__":
    paths, words = split_paths(sys.argv[1:])
    sys.argv[1:] = [*(path_option("path", path) for path in paths[:1]), *words]
    asked = check_command("reconstruct")
    with exit_with_message("stopped."):
        if asked is not None and len(paths) > 1:
            from asysplat.reconstruct.scenes import reconstruct_scenes

            interrupt_once()
            sys.exit(min(1, reconstruct_scenes(paths, words, asked)))
        if asked is not None and not OmegaConf.is_missing(asked, "path"):
            check_exists(Path(asked.path), "photographs or a video")

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from jaxtyping import Float
from torch import Tensor

from asysplat import load
from asysplat.data.cameras import CameraOptions
from asysplat.data.photographs import Photographs, open_photographs
from asysplat.errors import InputError
from asysplat.export import read_gaussians
from asysplat.export.viewer import Viewer
from asysplat.models.prior.prior import DepthEstimate
from asysplat.ranges import Count, Fraction, Positive, check_options
from asysplat.reconstruct.continuation import continue_run
from asysplat.reconstruct.display import SIGNALS, RefinementDisplay
from asysplat.reconstruct.results import Results
from asysplat.reconstruct.video import find_views
from asysplat.refinement import (
    RefinementSettings,
    ScaffoldSettings,
    refine,
    refine_scaffold,
    with_options,
    without_unneeded,
)
from asysplat.refinement.exposure import even_exposures, find_exposures
from asysplat.refinement.init import INITS, initial_gaussians, sweep
from asysplat.refinement.trial import CLEAR_GAIN, TRIAL_FROM, TRIAL_VIEWS, trial_gain
from asysplat.root import typed
from asysplat.runs.machine import find_device, free_gb
from asysplat.scene import Gaussians, Views
from asysplat.terminal import make_console

RANGES = {
    "last_fit": Fraction,
    "exposure": Literal["auto", "given"],
    "memory_gb": Positive | None,
}
PROGRAM_GB = 1.2  # of the process, without photographs and Gaussians
BYTES_PER_GAUSSIAN = 1200  # with gradients, averages of the optimizer, and copies of some
MARGIN_GB = 1.0  # that stays free


@command("reconstruct")
def reconstruct(config: DictConfig) -> None:
    """Find or refine cameras, initialize Gaussians, refine them, write the results."""
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    config = continue_run(config, given_options())
    if OmegaConf.is_missing(config, "path"):
        raise InputError(f"no photographs: {typed('reconstruct')} my_scene, a folder.")
    check_options({name: config[name] for name in RANGES}, RANGES)
    device = find_device(config.device)
    config = for_device(config, device, given_options())
    limit = read_limit(config)
    if config.view and find_spec("viser") is None:
        raise InputError("view=true needs viser: pip install 'asysplat[viewer]', or leave it out.")
    if config.init == "network" and config.checkpoint is None:
        raise InputError("init=network: name a trained one, checkpoint=....ckpt.")
    settings = instantiate(config.refinement)
    per_view = isinstance(settings, ScaffoldSettings)
    if per_view:
        config = without_scene_files(config, given_options())
    results = Results(Path(config.paths.run), config, per_view)
    names = ("height", "width", "views", "held_out_every", "max_held_out", "layout", "on_error")
    options = {name: config[name] for name in (*names, "masks", "background")}
    options["max_gb"] = photographs_gb(config, device)
    where = Path(config.paths.logs) / "cameras"
    options["cameras"] = CameraOptions(config.cameras, where, config.frames, make_console())
    photographs = open_photographs(config.path, **options)
    # an error of names comes before the work
    find_views(config.video, photographs.input_files, photographs.held_out_files)
    print(describe(config, photographs, limit))
    photographs = photographs.to(device)
    estimate, exposures = sweep(photographs.inputs), None
    if config.exposure == "auto":
        exposures = find_exposures(photographs.inputs, estimate)
    fitted = photographs
    if exposures is not None:
        most = (exposures.mean(-1).max() - exposures.mean(-1).min()).exp().item()
        print(f"exposure: some photographs are {most:.1f} times as bright as others (exposure=)")
        fitted = replace(photographs, inputs=even_exposures(photographs.inputs, exposures))
    if "refinement" not in given_options():
        limit = choose_refinement(config, fitted.inputs, limit)
        settings = instantiate(config.refinement)
    gaussians = initialize(config, fitted, settings, estimate)
    background = photographs.background
    results.save_start(gaussians, photographs, background, exposures)
    viewer = Viewer(photographs.inputs, background=background.tolist()) if config.view else None
    with RefinementDisplay(viewer) as display:
        options = {"background": background, "seed": config.seed, "watch": display, **limit}
        if per_view:
            anchors = refine_scaffold(gaussians, fitted.inputs, settings, **options)
            results.save(anchors, display.last)
            results.save_video(anchors)
            return
        refined = refine(gaussians, fitted.inputs, settings, estimate=estimate, **options)
        gaussians = without_unneeded(refined, fitted.inputs)
        if display.last.step >= settings.max_steps(photographs.inputs.num_views):
            print(f"ended after refinement.max_steps_per_image={settings.max_steps_per_image}")
        results.save(gaussians, display.last)
        fits_all = photographs.held_out is not None and not photographs.is_split
        if config.last_fit and fits_all and not display.stopped:
            gaussians = fit_to_all(
                refined, photographs, exposures, settings, config.last_fit, options
            )
            results.save_scene(gaussians)
        results.save_video(gaussians)
        display.show(gaussians)


def for_device(config: DictConfig, device: torch.device, given: set[str]) -> DictConfig:
    """Return the configuration for a device: on a GPU more of everything, unless it is chosen."""
    if device.type != "cuda" or config.run is not None or given & {"quality", "refinement"}:
        return config
    print("a GPU: quality=gpu; to avoid it, quality=good")
    return with_options(config, "quality/gpu", given)


def without_scene_files(config: DictConfig, given: set[str]) -> DictConfig:
    """Return the configuration for Gaussians that depend on the view, which no file holds."""
    refused = {
        f"output=[{','.join(config.output)}]": "output" in given and config.output,
        "view=true": config.view,
        "open=true": config.open,
        "video.path=orbit": config.video.path == "orbit",
        f"last_fit={config.last_fit}": config.last_fit,
    }
    for option, is_refused in refused.items():
        if is_refused:
            raise InputError(
                f"{option}: the Gaussians of refinement=scaffold_gs depend on the view, so no file "
                "or viewer holds them: leave it out, for metrics, pictures and a video."
            )
    config = config.copy()
    config.output = []
    return config


def photographs_gb(config: DictConfig, device: torch.device) -> float:
    """Compute the memory that is left for photographs, in GB; it may be negative."""
    memory = free_gb(device) - MARGIN_GB
    if config.memory_gb is not None:
        memory = config.memory_gb - PROGRAM_GB
    return memory - (config.refinement.max_gaussians or 0) * BYTES_PER_GAUSSIAN / 1e9


def describe(config: DictConfig, photographs: Photographs, limit: dict[str, float]) -> str:
    """Write a line of what is used, of what there is, and of the options that change it."""
    inputs, held_out = photographs.inputs, len(photographs.held_out_files)
    masked = 0.0 if inputs.masks is None else 1 - inputs.masks.float().mean().item()
    masked = f", {masked:.0%} of the pixels masked out" if masked >= 0.01 else ""
    (name, value), gaussians = next(iter(limit.items())), config.refinement.max_gaussians
    return (
        f"{inputs.num_views} of {photographs.total} photographs are fitted (views=), {held_out} "
        f"measure the result (held_out_every=), {inputs.cameras.height} pixels high (height=)"
        f"{masked}, at most {gaussians or math.inf:,} Gaussians (refinement.max_gaussians=), "
        f"{value:g} {name} ({name}=); all of these: quality=preview or best"
    )


def fit_to_all(
    gaussians: Gaussians,
    photographs: Photographs,
    exposures: Float[Tensor, "V 3"] | None,
    settings: RefinementSettings,
    fraction: float,
    options: dict[str, Any],
) -> Gaussians:
    """Refine Gaussians on all photographs for a fraction of the limit, without new Gaussians."""
    views = photographs.all_views()
    if exposures is not None and (found := find_exposures(views)) is not None:
        views = even_exposures(views, found - found[: len(exposures)].mean(0))  # as the inputs were
    print(f"last fit: {views.num_views} photographs, the held-out ones too, after the measurement")
    settings = replace(
        settings, half_resolution_until=0.0, densify="none", every=None, cool_down=1.0
    )
    for name in {"steps", "seconds"} & options.keys():
        options = options | {name: type(options[name])(max(1, fraction * options[name]))}
    return without_unneeded(refine(gaussians, views, settings, **options), views)


def given_options() -> set[str]:
    """Return the names of the options on the command line."""
    return {override.lstrip("+").partition("=")[0] for override in HydraConfig.get().overrides.task}


def read_limit(config: DictConfig) -> dict[str, float]:
    """Read the limit of the refinement: steps, or else seconds."""
    if {"steps", "seconds"} <= given_options() and None not in (config.steps, config.seconds):
        raise InputError(
            f"seconds={config.seconds} and steps={config.steps}: give one of them; steps are "
            "repeatable, seconds are not."
        )
    name = "seconds" if config.steps is None else "steps"
    check_options({name: config[name]}, {"seconds": Positive, "steps": Count})
    return {name: config.steps or float(config.seconds)}


def choose_refinement(
    config: DictConfig, inputs: Views, limit: dict[str, float]
) -> dict[str, float]:
    """Set the options for few photographs where there are few, unless a trial says otherwise.

    Returns the limit without the seconds of the trial.
    """
    began = time.perf_counter()
    given = (name.partition("refinement.")[2] for name in given_options())
    few = with_options(config.refinement, "refinement/few", filter(None, given))
    takes_few = inputs.num_views <= config.refinement.few_views
    why = "few photographs" if takes_few else ""
    ((name, amount),) = limit.items()
    may_differ = config.decide and config.refinement.few_views > 0
    if may_differ and inputs.num_views in TRIAL_VIEWS and amount >= TRIAL_FROM[name]:
        settings = instantiate(config.refinement), instantiate(few)
        gain, error = trial_gain(inputs, *settings, config.seed)
        if abs(gain) > max(CLEAR_GAIN, error):
            takes_few = gain > 0
        why = f"trial (decide=), {gain:+.1f} +- {error:.1f} dB by refinement=few"
        if name == "seconds":
            limit = {name: amount - (time.perf_counter() - began)}
    if why:
        print(f"{why}: refinement={'few' if takes_few else 'default'}, unless you name another")
    if takes_few:
        config.refinement = few
    return limit


def initialize(
    config: DictConfig,
    photographs: Photographs,
    settings: RefinementSettings | ScaffoldSettings,
    estimate: DepthEstimate,
) -> Gaussians:
    """Build the Gaussians to refine, in the network's frame, on the photographs' device."""
    init, network, device = config.init, None, photographs.inputs.images.device
    if init == "network":
        network = load(config.checkpoint).to(device)
    if init not in INITS and Path(str(init)).suffix:
        gaussians = read_gaussians(init, photographs.origin).to(device)
        gaussians = photographs.normalization.to_network(gaussians)
    else:
        known = photographs.points, network, estimate
        gaussians = initial_gaussians(init, photographs.inputs, settings.initial_limit, *known)
    print(f"start: {gaussians.num_gaussians:,} Gaussians by init={init}")
    return gaussians


if __name__ == "__main__":
    reconstruct()
