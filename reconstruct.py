"""Turn posed photographs into a scene of Gaussians that opens everywhere.

python reconstruct.py my_scene
"""

import os
import re
import signal
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read with torch: who waits must not spin
signal.signal(signal.SIGINT, signal.SIG_DFL)  # while modules load there is nothing to clean up

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from asysplat.errors import InputError, input_error_behind
from asysplat.export.gaussians import read_gaussians
from asysplat.export.results import Results
from asysplat.export.watch import SIGNALS, RefinementDisplay
from asysplat.interrupts import keep_interrupts
from asysplat.motion import transform
from asysplat.overrides import exit_at_unknown_overrides
from asysplat.refinement import mean_color, refine
from asysplat.refinement.init import INITS, best_init, initial_gaussians
from asysplat.refinement.photographs import Photographs, open_photographs
from asysplat.scene import Gaussians
from asysplat.training.load import load
from asysplat.training.ranges import check_ranges


@hydra.main(config_path="conf", config_name="reconstruct", version_base="1.3")
def main(config: DictConfig) -> None:
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        reconstruct(config)
    except KeyboardInterrupt:
        sys.exit("stopped.")
    except Exception as error:
        known = input_error_behind(error)
        if known is None:
            raise
        sys.exit(f"error: {known}")


def reconstruct(config: DictConfig) -> None:
    """Start, refine, hand over."""
    if OmegaConf.is_missing(config, "path"):
        raise InputError("no photographs: python reconstruct.py my_scene, a folder.")
    check_ranges(OmegaConf.masked_copy(config, "speed"))
    limits = limits_of(config)
    settings = instantiate(config.refinement)
    results = Results(Path(config.paths.run), config)
    photographs = open_photographs(
        config.path,
        config.height,
        config.width,
        config.views,
        config.held_out_every,
        config.max_held_out,
        config.layout,
        config.on_bad_image,
    )
    gaussians = start(config, photographs, settings.most)
    background = mean_color(photographs.inputs)
    results.first_picture(gaussians, photographs, background)
    with RefinementDisplay(photographs.inputs, config.view) as watch:
        gaussians = refine(
            gaussians,
            photographs.inputs,
            settings,
            background=background,
            seed=config.seed,
            watch=watch,
            **limits,
        )
        if watch.last.step >= settings.most_steps(photographs.inputs.num_views):
            print(f"ended: each photograph was looked at refinement.looks={settings.looks} times")
        results.save(gaussians, photographs, background, watch.last)
        watch.show(gaussians)


def limits_of(config: DictConfig) -> dict[str, float]:
    """Return how long is refined, before anything is read: steps, or else seconds."""
    name = "seconds" if config.steps is None else "steps"
    value, kinds = config[name], int if name == "steps" else int | float
    if not isinstance(value, kinds) or isinstance(value, bool) or not value > 0:
        raise InputError(f"{name}={value}: give a number above 0; steps go before seconds.")
    return {name: value if name == "steps" else float(value)}


def start(config: DictConfig, photographs: Photographs, most: int) -> Gaussians:
    """Return what the refinement starts from, in the network's frame."""
    init = config.init or best_init(photographs.inputs.num_views)
    network = None
    if init == "network":
        try:
            network = load(config.checkpoint)
            network.early_exit = instantiate(config.speed)
        except InputError as error:
            if config.init is not None:
                raise
            print(f"warning: {error} Starting from the plane sweep, init=plane_sweep.")
            init = "sweep"
    if init not in INITS and Path(init).suffix:
        frame = photographs.frame
        gaussians = transform(read_gaussians(init), frame.world_to_mean).scale_by(frame.scale)
    else:
        gaussians = initial_gaussians(init, photographs, most, network)
    print(f"start: {gaussians.num_gaussians:,} Gaussians by init={init}")
    if network is not None and network.skipped:
        shares = (f"{share:.0%} of {name}" for name, share in network.skipped.items())
        print(f"skipped by the network: {', '.join(shares)}")
    return gaussians


def as_overrides(words: list[str]) -> list[str]:
    """Write the first word as path=..., and --view as view=true."""
    view = ["view=true"] if "--view" in words else []
    words = [word for word in words if word != "--view"]
    if words and not words[0].startswith("-") and ("=" not in words[0] or Path(words[0]).exists()):
        # Hydra reads a backslash as one of its own only before a quote.
        quoted = re.sub(r"(\\+)(?='|$)", r"\1\1", words[0]).replace("'", "\\'")
        words[0] = f"path='{quoted}'"
    return words + view


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # at which pycolmap prints a stack trace
    keep_interrupts()
    os.environ.setdefault("ASYSPLAT_SHARED", str(Path(__file__).parents[1] / "shared"))
    sys.argv[1:] = as_overrides(sys.argv[1:])
    exit_at_unknown_overrides("reconstruct")
    main()
