"""Photographs held out, against the seconds of refinement: every start, and every part of it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from asysplat.benchmark.compare import DECIBELS, TIME, Watched
from asysplat.benchmark.options import check_names
from asysplat.benchmark.reconstruct.scene import SEED, MeasuredScene
from asysplat.benchmark.reconstruct.shown import ALL, START, plot, tables
from asysplat.benchmark.timing import Result
from asysplat.errors import InputError, input_error_behind
from asysplat.evaluation.lpips import load_lpips
from asysplat.models.network import Network
from asysplat.refinement import RefinementSettings
from asysplat.refinement.init import INITS
from asysplat.refinement.photographs import open_photographs
from asysplat.training.load import load

SIDE = 256  # pixels of the crops
Say = Callable[[str], None]
WATCHED = Watched(
    names=("scene", "init", "variant", "budget"),
    alike=(),
    kinds={
        "step": TIME,
        # How far a refinement comes in so many seconds depends on the machine, and on its load.
        "psnr": replace(DECIBELS, least=0.5, anywhere=False),
    },
)

__all__ = ["measure", "plot", "tables"]


def measure(options: DictConfig, console: Console) -> Result:
    """Refine the scenes `options.reconstruct.scenes`: from every init, and without every part.

    The whole refinement starts from each init and has each budget, a run of its own: what rates and
    sizes are follows the share of the budget. The variants start from the first init and have
    `options.reconstruct.budget`, unless they name an `init` of their own. Ctrl-C ends the suite
    with what was measured so far.

    Returns:
        "protocol": see `Protocol.sentences`; "complete": whether nothing was stopped; "scenes": the
        number of views of each that are fitted to and measured; "rows": what was measured of each
        scene, by "variant", "init" and "budget" in seconds, see `MeasuredScene`.

    Raises:
        InputError: an unknown option, or no scene is there.
    """
    wanted = options.reconstruct
    variants = OmegaConf.to_container(wanted).get("variants") or {}
    check_names("reconstruct.inits", wanted.inits, INITS)
    runs = find_runs(options.refinement, variants, wanted.inits[0])
    check_budgets([*wanted.budgets, wanted.budget])
    inits = {*wanted.inits, *(run.init for run in runs.values())}
    network = load() if "network" in inits else None
    protocol = instantiate(options.metrics)
    say = partial(console.print, markup=False, highlight=False, soft_wrap=True)
    lpips = load_lpips(protocol.lpips_net, Path(wanted.shared) / "weights")
    if lpips is None:
        say("LPIPS is left out: its weights are not here.")
    scenes, rows, complete = {}, [], False
    try:
        for name, folder in find_folders(wanted, say).items():
            photographs = open_photographs(folder, SIDE, SIDE, say=say)
            inputs, measured = photographs.inputs, photographs.measured
            scenes[name] = {"inputs": inputs.num_views, "measured": measured.num_views}
            scene = MeasuredScene(photographs, protocol, lpips)
            for row in measure_scene(scene, runs, options, network, say):
                rows.append({"scene": name} | row)
                say(_line(rows[-1]))
        complete = True
    except KeyboardInterrupt:
        if not rows:
            raise
        say("stopped: what was measured so far is kept.")
    return {
        "protocol": protocol.sentences(),
        "complete": complete,
        "size": [SIDE, SIDE],
        "seed": SEED,
        "inits": list(wanted.inits),
        "budget": wanted.budget,
        "goal": wanted.goal,
        "variants": variants,
        "scenes": scenes,
        "rows": rows,
    }


@dataclass(frozen=True)
class Run:
    """What a refinement starts from, one of INITS, and its settings."""

    init: str
    settings: RefinementSettings


def measure_scene(
    scene: MeasuredScene,
    runs: Mapping[str, Run],
    options: DictConfig,
    network: Network | None,
    say: Say,
) -> Iterator[Result]:
    """Yield the rows of a scene; a start for which it lacks something is left out.

    Args:
        scene: see `MeasuredScene`.
        runs: ALL and the variants.
        options: of the command.
        network: of init=network.
        say: is told what is left out.
    """
    wanted = options.reconstruct
    budgets = sorted({*wanted.budgets, wanted.budget})
    yield from scene.for_nothing()
    for init in dict.fromkeys([*wanted.inits, *(run.init for run in runs.values())]):
        try:
            gaussians, row = scene.start(init, runs[ALL].settings.most, network)
        except InputError as error:
            say(f"left out: {error}")
            continue
        yield {"init": init, "variant": START, "budget": 0} | row
        planned = [(ALL, budget) for budget in budgets if init in wanted.inits]
        planned += [
            (name, wanted.budget) for name in runs if name != ALL and runs[name].init == init
        ]
        for name, budget in planned:
            settings, seconds = runs[name].settings, float(budget)
            found = scene.refined(gaussians, settings, options.repeats, seconds=seconds)
            found["to_goal"] = seconds_to(wanted.goal, row["start"], found["curve"])
            yield {"init": init, "variant": name, "budget": budget} | found


def seconds_to(
    goal: float | int, start: float, curve: Sequence[tuple[float, float]]
) -> float | None:
    """Return when the PSNR first was as high, with the seconds of the start; None if never."""
    return next((start + seconds for seconds, psnr in curve if psnr >= goal), None)


def find_runs(refinement: DictConfig, variants: Mapping[str, Any], init: str) -> dict[str, Run]:
    """Return the runs: the whole refinement, called ALL, and each variant.

    Args:
        refinement: a file of conf/refinement.
        variants: by name, what is different from it, and `init`, where it starts, if elsewhere.
        init: of the others.

    Raises:
        InputError: an unknown start or setting, or one out of range.
    """
    found = {}
    for name, different in ({ALL: {}} | variants).items():
        try:
            parts = {**different}
            start = parts.pop("init", init)
            found[name] = Run(start, instantiate(OmegaConf.merge(refinement, parts)))
        except (OmegaConfBaseException, InstantiationException, TypeError, ValueError) as error:
            said = input_error_behind(error) or f"{different} are no settings of a refinement."
            raise InputError(f"reconstruct.variants.{name}: {said}") from None
        check_names(f"reconstruct.variants.{name}.init", [start], INITS)
    return found


def check_budgets(budgets: list) -> None:
    """Raise InputError unless all are numbers above 0."""
    for budget in budgets:
        if not isinstance(budget, int | float) or not 0 < budget < float("inf"):
            raise InputError(
                f"reconstruct has the budget {budget}: give seconds of refinement, above 0."
            )


def find_folders(wanted: DictConfig, say: Say) -> dict[str, Path]:
    """Return the folder of each scene that is there; say which are not.

    Raises:
        InputError: none is there.
    """
    places = {name: Path(wanted.shared) / "data" / name for name in wanted.scenes}
    there = {name: place for name, place in places.items() if place.is_dir()}
    for name, place in places.items():
        if name not in there:
            say(f"{name} is left out: {place} is no folder.")
    if not there:
        raise InputError(
            f"reconstruct.scenes={list(wanted.scenes)}: none is a folder of "
            f"{Path(wanted.shared) / 'data'}; set ASYSPLAT_SHARED to the folder that holds data/."
        )
    return there


def _line(row: Result) -> str:
    """Write a row as it is measured."""
    after = f" after {row['budget']:g} s" if "budget" in row else ""
    start = f" from {row['init']}" if "init" in row else ""
    return f"{row['scene']}: {row['variant']}{start}{after}, {row['psnr']:.2f} dB"
