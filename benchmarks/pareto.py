"""Run time against error: every variant of a prediction and of a refinement, one at a time.

A setting renders all held-out views of a scene from photographs in memory. A variant is what a
setting changes of the base of its family.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, partial
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import matplotlib
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lpips import LPIPS
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.progress import Progress, track
from rich.table import Table
from torch import Tensor

from asysplat import load
from asysplat.data.normalize import Normalization, normalize
from asysplat.data.photographs import Photographs, open_photographs
from asysplat.data.procedural import ProceduralScene
from asysplat.data.procedural.scene import split_seed
from asysplat.data.selection.views import evenly_spaced, uniform_selection
from asysplat.errors import InputError, input_error_behind
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.measured_cost import PEAK_MEMORY, CostMeter
from asysplat.evaluation.protocol import Protocol
from asysplat.models.network import Network
from asysplat.refinement import merge_to_limit, refine
from asysplat.refinement.init import INITS, initial_gaussians
from asysplat.rendering import INRIA, render
from asysplat.report.front import draw_front
from asysplat.report.style import FAINT, OURS, STYLE
from asysplat.runs.device import find_device
from asysplat.scene import Views
from benchmarks import timing
from benchmarks.compare import DECIBELS, LPIPS_DISTANCE, TIME, Watched
from benchmarks.options import CPU, PRECISIONS, check_names
from benchmarks.table import Columns, machine_note, make_table, median_iqr_column, number, text
from benchmarks.timing import Measurement, Result, summary

WHOLE = {"views", "side", "max_gaussians", "views_at_once", "steps"}  # numbers of a setting
BASE = "base"  # the setting that each variant changes
EXACT = "fp64"
SIZES = {"inputs": 16, "targets": 4}  # most views of a scene, unless its family says otherwise
FRAMES = 96  # frames of a procedural scene
PROCEDURAL = {"room": "rooms", "outdoors": "outdoors"}  # test scenes, by their `places`
REAL = ("fern", "fox", "hololens-000", "mydesk")  # folders of data/; others may be there, too
HELD_OUT_EVERY = 8
MIN_SQUARED_ERROR = 1e-20  # error of equal images: 200 dB, as JSON has no infinity
# The PSNR after so many seconds depends on the load of the machine: half of 0.5 dB, and of LPIPS.
NOISE_OF_SECONDS = {"psnr": 0.25, "lpips": 0.02}
WATCHED = Watched(
    names=("family", "scene", "setting"),
    alike=("side", "values"),
    kinds={"seconds": TIME, "error.decibels": DECIBELS._replace(min_change=1.0)}
    | {"psnr": DECIBELS, "lpips": LPIPS_DISTANCE},
)
TITLES = {
    "feed_forward": "Feed-forward",
    "sequence": "Feed-forward, more and more photographs",
    "networks": "Other layers, untrained",
    "refined": "Refined",
    "reconstruct": "Refined for some seconds",
}
QUALITIES = {  # higher is better
    "psnr": "PSNR against photographs, dB",
    "error": "PSNR against the exact images, dB",
}
NOTES = f"""\
-: not measured; photographs in memory to all held-out views; / base: in the same round, in turns
GB: {PEAK_MEMORY["cpu"]} of the process, {PEAK_MEMORY["cuda"]} on a GPU
error: of images in [0, 1] against the base in float64, of other layers against their own, of \
refinements against the base"""


class Drawn(NamedTuple):
    """All held-out views of a scene, and the number of the Gaussians that they show."""

    images: Tensor  # [V, 3, H, W]
    gaussians: int


RenderScene = Callable[[Photographs], Drawn]


@dataclass(frozen=True)
class FeedForward:
    """A network's prediction, with some of its Gaussians merged or left out, rendered."""

    views: int  # input views
    side: int  # side of the input views, in pixels
    checkpoint: str | None = "shipped"  # see `load`; None: untrained
    # Overrides of train.py; with a checkpoint they may change no weights.
    overrides: Sequence[str] = ()
    precision: str = "fp32"  # fp32; bf16: the network by autocast; fp64: the network and all else
    min_opacity: float = 0.0  # below which Gaussians are dropped
    cell: float | None = None  # pixels: Gaussians in a cell are merged; None: none are
    max_gaussians: int | None = None  # cells grow until so few are left
    sh_degree: int | None = None  # greatest SH degree rendered; None: all
    views_at_once: int | None = None  # rendered; None: all
    limits: Mapping[str, float] = field(default_factory=dict)  # fields of `BlendingLimits`

    def __post_init__(self):
        check_names("precision", [self.precision], [*PRECISIONS, EXACT])
        if self.limits:
            check_names("limits", self.limits, vars(INRIA))

    @property
    def trained(self) -> bool:
        return self.checkpoint is not None

    def prepare(self, refinement: DictConfig, device: torch.device) -> RenderScene:
        """Load the network, if its weights fit; return the function that renders a scene."""
        net = _load_network(self.checkpoint, tuple(self.overrides))
        dtype = torch.float64 if self.precision == EXACT else torch.float32
        if (device, dtype) != (CPU, torch.float32):
            net = deepcopy(net).to(device, dtype)
        half = PRECISIONS.get(self.precision) == torch.bfloat16
        options = {"sh_degree": self.sh_degree, "views_at_once": self.views_at_once}
        options |= {"depth": False, "limits": replace(INRIA, **self.limits)}

        @torch.no_grad()
        def run(scene: Photographs) -> Drawn:
            scene = select_inputs(scene, self.views, self.side)
            inputs, targets = scene.inputs.to(dtype), scene.held_out.to(dtype)
            with torch.autocast(device.type, torch.bfloat16, enabled=half):
                gaussians = net(inputs)
            gaussians = gaussians.to(dtype)
            if self.min_opacity > 0:
                gaussians = gaussians.keep(gaussians.opacities >= self.min_opacity)
            if self.cell is not None or self.max_gaussians is not None:
                limit = self.max_gaussians or gaussians.num_gaussians
                gaussians = merge_to_limit(gaussians, inputs.cameras, self.cell or 1.0, limit)
            image = render(gaussians, targets.cameras, inputs.mean_color(), **options).image
            return Drawn(image, gaussians.num_gaussians)

        return run


@dataclass(frozen=True)
class Refined:
    """A start and a refinement of so many steps or seconds, rendered."""

    views: int | None  # input views; None: all, as they are
    side: int | None  # side of the input views, in pixels; None with `views`
    steps: int | None = None  # every round gives the same bits; 0: the start alone
    seconds: float | int | None = None  # in place of steps
    init: str = "plane_sweep"  # see `initial_gaussians`; the network is the shipped one
    refinement: Mapping[str, Any] = field(default_factory=dict)  # over the file of conf/refinement

    trained = True

    def __post_init__(self):
        check_names("init", [self.init], INITS)
        if (self.steps is not None) == (0 < (self.seconds or 0) < math.inf):
            raise InputError(
                f"steps={self.steps} and seconds={self.seconds}: give one of them, above 0."
            )

    def prepare(self, refinement: DictConfig, device: torch.device) -> RenderScene:
        """Check the settings; return the function that renders a scene on the CPU."""
        try:
            settings = instantiate(OmegaConf.merge(refinement, dict(self.refinement)))
        except (OmegaConfBaseException, InstantiationException, TypeError, ValueError) as error:
            message = f"{self.refinement} are no settings of a refinement."
            raise InputError(str(input_error_behind(error) or message)) from None
        net = _load_network("shipped", ()) if self.init == "network" else None
        limit = {"steps": self.steps, "seconds": self.seconds}

        def run(scene: Photographs) -> Drawn:
            scene = select_inputs(scene, self.views, self.side)
            gaussians = initial_gaussians(self.init, scene, settings, net)
            color = scene.inputs.mean_color()
            if self.steps != 0:
                gaussians = refine(gaussians, scene.inputs, settings, background=color, **limit)
            with torch.no_grad():
                image = render(gaussians, scene.held_out.cameras, color, depth=False).image
            return Drawn(image, gaussians.num_gaussians)

        return run


FAMILIES = dict.fromkeys(("feed_forward", "sequence", "networks"), FeedForward)
FAMILIES |= dict.fromkeys(("refined", "reconstruct"), Refined)
Setting = FeedForward | Refined


@cache
def _load_network(checkpoint: str | None, overrides: tuple[str, ...]) -> Network:
    torch.manual_seed(0)
    return load(checkpoint, overrides)


def find_families(config: Mapping[str, Any]) -> dict[str, dict[str, Setting]]:
    """Return the settings of each family of `config.families`: the base, and those of its variants.

    Raises:
        InputError: an unknown family, variant or field of a setting, or a value out of range.
    """
    check_names("pareto.families", config["families"], FAMILIES)
    families = {}
    for family in config["families"]:
        kind, base = FAMILIES[family], config[family]["base"]
        families[family] = {}
        for name, changes in ({BASE: {}} | (config[family]["variants"] or {})).items():
            where = f"pareto.{family}.{name}"
            if not isinstance(changes, Mapping):
                raise InputError(f"{where}={changes} is no setting: give {{name: value}}.")
            values = base | changes
            check_names(where, values, [field.name for field in fields(kind)])
            for count in WHOLE & values.keys():
                value, minimum = values[count], int(count != "steps")
                if value is not None and (type(value) is not int or value < minimum):
                    message = f"{where}: {count}={value}: give a whole number from {minimum}."
                    raise InputError(message)
            try:
                families[family][name] = kind(**values)
            except InputError as error:
                raise InputError(f"{where}: {error}") from error
    if (chosen := config["variants"]) != "all":
        names = dict.fromkeys(name for settings in families.values() for name in settings)
        check_names("pareto.variants", chosen, [*names, "all"])
        for settings in families.values():
            for name in settings.keys() - {BASE, *chosen}:
                del settings[name]
    return families


def find_scenes(
    names: Sequence[str], folder: Path
) -> tuple[dict[str, Callable[[int, int, int], Photographs]], dict[str, str]]:
    """Return functions that open scenes, and the reasons why others are not measured.

    The functions take the side of the photographs in pixels, and the largest numbers of input and
    of held-out views. `names` are of PROCEDURAL, REAL, or folders in `folder`.

    Raises:
        InputError: a name that no scene has, or no scene is there.
    """
    present = sorted(path.name for path in folder.glob("*") if path.is_dir())
    check_names("pareto.scenes", names, dict.fromkeys([*PROCEDURAL, *REAL, *present]))
    scenes, absent = {}, {}
    for name in names:
        if name in PROCEDURAL:
            scenes[name] = partial(_procedural_scene, name)
        elif name in present:
            scenes[name] = partial(_real_scene, folder / name)
        else:
            absent[name] = f"{folder / name} is no folder"
    if not scenes:
        raise InputError(
            f"pareto.scenes={list(names)}: none is a folder of {folder}; set ASYSPLAT_SHARED to "
            f"the folder that holds data/, or take of {', '.join(PROCEDURAL)}."
        )
    return scenes, absent


def _procedural_scene(name: str, side: int, inputs: int, targets: int) -> Photographs:
    scene = ProceduralScene(split_seed("test", 0), side, side, FRAMES, places=PROCEDURAL[name])
    frames = uniform_selection(FRAMES, inputs, targets)
    views = [_without_depths(scene.views(chosen)) for chosen in (frames.inputs, frames.targets)]
    frame = Normalization(torch.eye(4, dtype=torch.float64), 1.0)
    return Photographs(name, *views, [], [], frame, None)


def _real_scene(path: Path, side: int, inputs: int, targets: int) -> Photographs:
    # The check of the cameras needs more pixels: its warning is dropped.
    limits = {"views": inputs, "held_out_every": HELD_OUT_EVERY, "max_held_out": targets}
    return open_photographs(path, side, side, **limits, say=lambda _: None)


def _without_depths(views: Views) -> Views:
    return replace(views, depths=None, masks=None, point_depths=None)


def select_inputs(scene: Photographs, views: int | None, side: int | None) -> Photographs:
    """Return a scene with `views` of its inputs, evenly, of side x side pixels, without depths.

    It is normalized anew. A scene with fewer views gives all of them; None: the scene as it is.

    Raises:
        InputError: more pixels than the photographs have.
    """
    if views is None or side is None:
        return scene
    cameras = scene.inputs.cameras
    if side > cameras.height:
        raise InputError(
            f"pareto has a setting with side={side}: give at most pareto.side={cameras.height}."
        )
    selected = evenly_spaced(range(cameras.num_views), min(views, cameras.num_views))
    inputs = _without_depths(scene.inputs.select(selected))
    if side != cameras.height:
        inputs = inputs.resized(side, side)
    inputs, targets, _ = normalize(inputs, _without_depths(scene.held_out))
    return replace(scene, inputs=inputs, held_out=targets, points=None)


def _measure_scene(
    scene: Photographs,
    settings: Mapping[str, Setting],
    renderers: Mapping[str, RenderScene],
    protocol: Protocol,
    lpips: LPIPS | None,
    refinement: DictConfig,
    device: torch.device,
    repeats: int,
    advance: Callable[[], None],
) -> list[Result]:
    """Measure all settings in turns, those with a limit in seconds once; return a row for each.

    Networks are on the device, refinements on the CPU. A setting other than BASE that cannot render
    this scene has no numbers, but the reason in "not_measured". `advance` is called after each of
    the `count_runs`.
    """
    base = settings[BASE]
    own_device = CPU if isinstance(base, Refined) else device
    views = {name: getattr(scene, name).to(own_device) for name in ("inputs", "held_out")}
    scene = replace(scene, **views)
    drawn, measurements, absent = {}, {}, {}
    meters = {name: CostMeter(own_device) for name in settings}

    def run(name: str) -> dict[str, float]:
        meters[name].start()
        drawn[name] = renderers[name](scene)
        meters[name].stop()
        advance()
        return {"seconds": meters[name].seconds[-1]}

    once = runs_once(base)
    if once:  # compiles kernels
        replace(base, seconds=None, steps=1).prepare(refinement, CPU)(scene)
    for name in settings:
        try:
            first = run(name)["seconds"]
            seconds = {"seconds": [first]} if once else {}
            measurements[name] = Measurement(partial(run, name), seconds=seconds)
        except InputError as error:
            if name == BASE:
                raise
            absent[name] = str(error)
    if not once:
        timing.time_in_rounds(list(measurements.values()), repeats)
    exact_images = {repr(base): drawn[BASE].images}
    rows = []
    for name, setting in settings.items():
        row = {"setting": name, "values": asdict(setting), "not_measured": absent.get(name)}
        empty = ("seconds", "over_base", "error", "psnr", "ssim", "lpips", "gaussians", "peak_gb")
        row |= dict.fromkeys(empty)
        if name in measurements:
            seconds, base_seconds = (measurements[n].seconds["seconds"] for n in (name, BASE))
            ratios = [a / b for a, b in zip(seconds, base_seconds, strict=True)]
            row |= {"seconds": summary(seconds), "over_base": summary(ratios)}
            row["gaussians"] = drawn[name].gaussians
            row["peak_gb"] = max(meters[name].gb, default=None)
            exact = base
            if isinstance(setting, FeedForward):
                exact = replace(base if setting.trained else setting, precision=EXACT)
            if exact != setting:
                key = repr(exact)
                if key not in exact_images:
                    exact_images[key] = exact.prepare(refinement, device)(scene).images
                row["error"] = {"decibels": decibels(drawn[name].images, exact_images[key])}
            if setting.trained:
                metrics = protocol.image_metrics(drawn[name].images, scene.held_out, lpips)
                row |= {metric: values.mean().item() for metric, values in metrics.items()}
        rows.append(row | ({"noise": NOISE_OF_SECONDS} if once else {}))
    return rows


def runs_once(base: Setting) -> bool:
    """Return whether the settings of this base have a limit in seconds."""
    return isinstance(base, Refined) and base.seconds is not None


def count_runs(settings: Mapping[str, Setting], repeats: int) -> int:
    """Count the runs of all settings on a scene: once, or also in a warm-up and the rounds."""
    return len(settings) * (1 if runs_once(settings[BASE]) else 2 + repeats)


def decibels(image: Tensor, exact: Tensor) -> float:
    """Compare images, clamped to [0, 1], by the decibels of their mean squared error."""
    error = image.double().clamp(0, 1) - exact.double().clamp(0, 1)
    return -10 * error.square().mean().clamp_min(MIN_SQUARED_ERROR).log10().item()


def measure(options: DictConfig, console: Console) -> Result:
    """Render the held-out views of `options.pareto.scenes` with every variant.

    All settings of a family take turns on a scene, in `options.repeats` rounds; those of seconds
    run once.

    Returns:
        "rows": one for each family, scene and setting: "seconds", their ratio to the base's of the
        same round "over_base", "error" of the images against the exact ones in "decibels", and
        metrics against the photographs, the number of "gaussians", and "peak_gb", the largest
        `peak_memory_gb` of all runs; None for what was not measured.
        "not_measured": what, and why.
    """
    config = OmegaConf.to_container(options.pareto, resolve=True)
    shared = Path(config["shared"])
    families = find_families(config)
    protocol = instantiate(options.metrics)
    lpips = load_lpips(protocol.lpips_net, shared / "weights")
    device = find_device(options.device)
    loads = [(family, *pair) for family, settings in families.items() for pair in settings.items()]
    renderers: dict[str, dict[str, RenderScene]] = {family: {} for family in families}
    for family, name, setting in track(loads, "loading", console=console, transient=True):
        renderers[family][name] = setting.prepare(options.refinement, device)
    scenes, absent = find_scenes(config["scenes"], shared / "data")
    common = (protocol, lpips, options.refinement, device, options.repeats)
    if lpips is None:
        absent["LPIPS"] = f"{shared / 'weights'} has no weights of its backbone"
    if not torch.cuda.is_available():
        absent["a GPU"] = "there is none"
    rows: list[Result] = []
    parts = [
        (name, f) for name in scenes for f in families if name in (config[f]["scenes"] or scenes)
    ]
    total = sum(count_runs(families[family], options.repeats) for _, family in parts)
    with Progress(console=console, transient=True) as bars:
        advance = partial(bars.advance, bars.add_task("measuring", total=total))
        for name, family in parts:
            sizes = {"side": config["side"]} | SIZES | (config[family].get("photographs") or {})
            scene, settings = scenes[name](**sizes), families[family]
            scene_rows = _measure_scene(
                scene, settings, renderers[family], *common, advance=advance
            )
            console.print(f"{name}: {family}, {len(scene_rows)} settings", highlight=False)
            where = {"family": family, "scene": name, "side": sizes["side"]}
            rows += [where | row for row in scene_rows]
    for row in [row for row in rows if row["not_measured"]]:
        absent["{family}, {scene}, {setting}".format(**row)] = row["not_measured"]
    return {"protocol": protocol.describe(), "not_measured": absent, "rows": rows}


def summarize(rows: Sequence[Result]) -> list[Result]:
    """Average each setting of each family over the scenes that it was measured on.

    Returns:
        "over_base" is a geometric mean; "lost" is the PSNR below the base's; "busy" whether some
        scene was measured on a busy machine. None for what was measured on no scene.
    """
    bases = {(row["family"], row["scene"]): row for row in rows if row["setting"] == BASE}
    means = []
    for (family, name), group in _grouped(rows, "family", "setting").items():
        timed = [row for row in group if row["seconds"]]
        values = {
            "seconds": [row["seconds"]["median"] for row in timed],
            "over_base": [math.log(row["over_base"]["median"]) for row in timed],
            "psnr": [row["psnr"] for row in timed if row["psnr"] is not None],
            "lpips": [row["lpips"] for row in timed if row["lpips"] is not None],
            "error": [row["error"]["decibels"] for row in timed if row["error"]],
        }
        values["lost"] = [
            bases[family, row["scene"]]["psnr"] - row["psnr"] for row in timed if row["psnr"]
        ]
        row = {key: fmean(numbers) if numbers else None for key, numbers in values.items()}
        row["over_base"] = math.exp(row["over_base"]) if timed else None
        busy = any(row["seconds"]["busy"] for row in timed)
        row |= {"family": family, "setting": name, "scenes": len(timed), "busy": busy}
        means.append(row)
    return means


def _grouped(rows: Sequence[Result], *names: str) -> dict[tuple[str, ...], list[Result]]:
    groups: dict[tuple[str, ...], list[Result]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def tables(results: Result) -> list[Table]:
    """Show each scene's settings, then the means over scenes of each family."""
    absent = "\n".join(f"not measured: {k}, {why}" for k, why in results["not_measured"].items())
    notes = "\n".join(filter(None, (machine_note(results), NOTES, absent)))
    scenes = _grouped(results["rows"], "family", "scene").items()
    shown = [make_table(f"{TITLES[name]}, {scene}", ROWS, rows) for (name, scene), rows in scenes]
    for (name,), rows in _grouped(summarize(results["rows"]), "family").items():
        shown.append(make_table(f"{TITLES[name]}, means over scenes", MEANS, rows, notes))
    return shown


def plot(results: Result) -> Figure:
    """Plot the means of each family: PSNR, or the error where there is none, against seconds."""
    families = _grouped(summarize(results["rows"]), "family")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(1.0 + 5.2 * len(families), 5.0), layout="constrained")
        grid = figure.subplots(1, len(families), squeeze=False)[0]
        for axes, ((family,), rows) in zip(grid, families.items(), strict=True):
            quality = "psnr" if any(row["psnr"] is not None for row in rows) else "error"
            points = [(row["setting"], row["seconds"], row[quality]) for row in rows]
            axes.set(title=TITLES[family], xlabel="seconds", ylabel=QUALITIES[quality])
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
            busy = [row["setting"] for row in rows if row["busy"]]
            draw_front(axes, [p for p in points if None not in p], "higher", OURS, busy)
        note = "hollow: measured while the machine was busy; crowded names are left out"
        figure.supxlabel(note, fontsize=9, color=FAINT)
    return figure


ROWS: Columns = {
    "setting": text("{setting}"),
    "ms": median_iqr_column("seconds"),
    "/ base": median_iqr_column("over_base", "{:.2f}", unit=1.0),
    "PSNR": number("psnr", "{:.2f}"),
    "LPIPS": number("lpips", "{:.3f}"),
    "Gaussians": number("gaussians", "{:,}"),
    "GB": number("peak_gb", "{:.2f}"),
    "error\ndB": number("error.decibels", "{:.1f}"),
}
MEANS: Columns = {
    "setting": text("{setting}"),
    "scenes": text("{scenes}"),
    "ms": number("seconds", "{:.0f}", unit=1e-3),
    "": lambda row: "busy" if row["busy"] else "",
    "/ base": number("over_base", "{:.2f}"),
    "PSNR": number("psnr", "{:.2f}"),
    "PSNR\nlost": number("lost", "{:+.2f}"),
    "LPIPS": number("lpips", "{:.3f}"),
    "error\ndB": number("error", "{:.1f}"),
}
