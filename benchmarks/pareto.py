"""Run time against error: every variant of a prediction and of a refinement, one at a time.

A setting says how the held-out views of a scene are rendered from its photographs. A family of
settings consists of a base and of variants, each of which changes some values of the base.
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
from asysplat.data.selection import evenly_spaced, uniform_selection
from asysplat.errors import InputError, input_error_behind
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.measured_cost import PEAK_MEMORY, CostMeter
from asysplat.evaluation.protocol import Protocol
from asysplat.models.network import Network
from asysplat.refinement import merge_to_limit, refine
from asysplat.refinement.init import INITS, initial_gaussians
from asysplat.rendering import INRIA, render
from asysplat.runs.machine import find_device
from asysplat.scene import Views
from benchmarks import timing
from benchmarks.compare import DECIBELS, LPIPS_DISTANCE, TIME, TrackedMetrics
from benchmarks.options import CPU, PRECISIONS, check_names
from benchmarks.table import (
    Columns,
    machine_note,
    make_table,
    median_iqr_column,
    number_column,
    text_column,
)
from benchmarks.timing import Measurement, Result, summarize
from paper.front import draw_front
from paper.style import FAINT, OURS, STYLE

# Values of a setting that must be whole numbers
WHOLE_NUMBERS = {"views", "side", "max_gaussians", "views_at_once", "steps"}
BASE = "base"  # name of the setting that each variant changes
EXACT = "fp64"
SIZES = {"inputs": 16, "targets": 4}  # most views of a scene, unless the family sets its own
FRAMES = 96  # frames of a procedural scene
PROCEDURAL = {"room": "rooms", "outdoors": "outdoors"}  # test scenes: name, and `places`
REAL = ("fern", "fox", "hololens-000", "mydesk")  # known folders of data/, absent or not
HELD_OUT_EVERY = 8
MIN_SQUARED_ERROR = 1e-20  # equal images have 200 dB, since JSON has no infinity
# Metrics after a number of seconds depend on the load of the machine. Two results are compared by
# the sum of their noise: 0.5 dB, and 0.04 of LPIPS.
NOISE_OF_SECONDS = {"psnr": 0.25, "lpips": 0.02}
TRACKED = TrackedMetrics(
    names=("family", "scene", "setting"),
    must_match=("side", "values"),
    kinds={"seconds": TIME, "error.decibels": DECIBELS._replace(min_change=1.0)}
    | {"psnr": DECIBELS, "lpips": LPIPS_DISTANCE},
)
TITLES = {
    "feed_forward": "Feed-forward",
    "networks": "Other layers, untrained",
    "refined": "Refined",
    "reconstruct": "Refined for some seconds",
}
QUALITIES = {  # higher is better
    "psnr": "PSNR against photographs, dB",
    "error": "PSNR against the exact images, dB",
}
NOTES = f"""\
-: not measured; time: from photographs in memory to all held-out views; / base: ratio to the base \
in the same round
GB: {PEAK_MEMORY["cpu"]} of the process, {PEAK_MEMORY["cuda"]} on a GPU
error: PSNR of images in [0, 1] against the base in float64; of other layers, against the same \
layers in float64; of refinements, against the base"""


class RenderedViews(NamedTuple):
    """All held-out views of a scene as rendered, and the number of Gaussians that they show."""

    images: Tensor  # [V, 3, H, W]
    num_gaussians: int


RenderScene = Callable[[Photographs], RenderedViews]


@dataclass(frozen=True)
class FeedForward:
    """A setting that renders a model's prediction, some of its Gaussians merged or dropped."""

    views: int  # input views
    side: int  # side of the input views, in pixels
    checkpoint: str | None = "shipped"  # see `load`; None: untrained
    overrides: Sequence[str] = ()  # options of train.py, see `load`
    precision: str = "fp32"  # fp32; bf16: autocast of a network; fp64: everything in float64
    min_opacity: float = 0.0  # Gaussians of a lower opacity are dropped
    cell: float | None = None  # side in pixels of the cells in which Gaussians are merged
    max_gaussians: int | None = None  # cells grow until at most this many are left; None: no limit
    views_at_once: int | None = None  # number of views rendered together; None: all
    limits: Mapping[str, float] = field(default_factory=dict)  # cut-offs of the renderer

    def __post_init__(self):
        check_names("precision", [self.precision], [*PRECISIONS, EXACT])
        if self.limits:
            check_names("limits", self.limits, vars(INRIA))

    @property
    def trained(self) -> bool:
        return self.checkpoint is not None

    def prepare(self, refinement: DictConfig, device: torch.device) -> RenderScene:
        """Load the network; return the function that renders a scene on the device."""
        net = _load_network(self.checkpoint, tuple(self.overrides))
        dtype = torch.float64 if self.precision == EXACT else torch.float32
        if (device, dtype) != (CPU, torch.float32):
            net = deepcopy(net).to(device, dtype)
        half = PRECISIONS.get(self.precision) == torch.bfloat16
        options = {"views_at_once": self.views_at_once, "depth": False}
        options["limits"] = replace(INRIA, **self.limits)

        @torch.no_grad()
        def run(scene: Photographs) -> RenderedViews:
            scene = select_inputs(scene, self.views, self.side)
            inputs, targets = scene.inputs.decoded().to(dtype), scene.held_out.to(dtype)
            with torch.autocast(device.type, torch.bfloat16, enabled=half):
                gaussians = net(inputs)
            gaussians = gaussians.to(dtype)
            if self.min_opacity > 0:
                gaussians = gaussians.keep(gaussians.opacities >= self.min_opacity)
            if self.cell is not None or self.max_gaussians is not None:
                limit = self.max_gaussians or gaussians.num_gaussians
                gaussians = merge_to_limit(gaussians, inputs.cameras, self.cell or 1.0, limit)
            image = render(gaussians, targets.cameras, inputs.mean_color(), **options).image
            return RenderedViews(image, gaussians.num_gaussians)

        return run


@dataclass(frozen=True)
class Refined:
    """A setting that renders the refinement of a start, limited in steps or in seconds."""

    views: int | None  # input views; None: all, at their size
    side: int | None  # side of the input views, in pixels; None if `views` is None
    steps: int | None = None  # limit under which every round is the same; 0: the start alone
    seconds: float | int | None = None  # limit instead of `steps`
    init: str = "plane_sweep"  # see `initial_gaussians`
    refinement: Mapping[str, Any] = field(default_factory=dict)  # overrides of conf/refinement

    trained = True

    def __post_init__(self):
        check_names("init", [self.init], INITS)
        if (self.steps is not None) == (0 < (self.seconds or 0) < math.inf):
            raise InputError(
                f"steps={self.steps} and seconds={self.seconds}: give one of them, above 0."
            )

    def prepare(self, refinement: DictConfig, device: torch.device) -> RenderScene:
        """Check the refinement's settings; return the function that renders a scene on the CPU."""
        try:
            settings = instantiate(OmegaConf.merge(refinement, dict(self.refinement)))
        except (OmegaConfBaseException, InstantiationException, TypeError, ValueError) as error:
            message = f"{self.refinement} are no settings of a refinement."
            raise InputError(str(input_error_behind(error) or message)) from None
        limit = {"steps": self.steps, "seconds": self.seconds}

        def run(scene: Photographs) -> RenderedViews:
            scene = select_inputs(scene, self.views, self.side)
            gaussians = initial_gaussians(
                self.init, scene.inputs, settings.initial_limit, scene.points
            )
            color = scene.inputs.mean_color()
            if self.steps != 0:
                gaussians = refine(gaussians, scene.inputs, settings, background=color, **limit)
            with torch.no_grad():
                image = render(gaussians, scene.held_out.cameras, color, depth=False).image
            return RenderedViews(image, gaussians.num_gaussians)

        return run


FAMILIES = dict.fromkeys(("feed_forward", "networks"), FeedForward)
FAMILIES |= dict.fromkeys(("refined", "reconstruct"), Refined)
Setting = FeedForward | Refined


@cache
def _load_network(checkpoint: str | None, overrides: tuple[str, ...]) -> Network:
    torch.manual_seed(0)
    return load(checkpoint, overrides)


def find_families(config: Mapping[str, Any]) -> dict[str, dict[str, Setting]]:
    """Return the settings of each of `config.families` by name: the base, and the variants."""
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
            for count in WHOLE_NUMBERS & values.keys():
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
    names: Sequence[str], folder: Path, option: str = "pareto.scenes"
) -> tuple[dict[str, Callable[[int, int, int], Photographs]], dict[str, str]]:
    """Find scenes by name.

    Args:
        names: names of PROCEDURAL, of REAL, or of folders in `folder`.
        folder: folder of the real scenes.
        option: name of the option that names them.

    Returns:
        Functions that open the scenes, and the reasons why other scenes are absent, both by name.
        The functions take the side of the photographs in pixels, and the largest numbers of input
        and of held-out views.
    """
    present = sorted(path.name for path in folder.glob("*") if path.is_dir())
    check_names(option, names, dict.fromkeys([*PROCEDURAL, *REAL, *present]))
    scenes, absent = {}, {}
    for name in names:
        if name in PROCEDURAL:
            scenes[name] = partial(_open_procedural_scene, name)
        elif name in present:
            scenes[name] = partial(_open_real_scene, folder / name)
        else:
            absent[name] = f"{folder / name} is no folder"
    if not scenes:
        raise InputError(
            f"{option}={list(names)}: none is a folder of {folder}; set ASYSPLAT_SHARED to "
            f"the folder that holds data/, or take of {', '.join(PROCEDURAL)}."
        )
    return scenes, absent


def _open_procedural_scene(name: str, side: int, inputs: int, targets: int) -> Photographs:
    scene = ProceduralScene(split_seed("test", 0), side, side, FRAMES, places=PROCEDURAL[name])
    frames = uniform_selection(FRAMES, inputs, targets)
    views = [_without_depths(scene.views(chosen)) for chosen in (frames.inputs, frames.targets)]
    normalization = Normalization(torch.eye(4, dtype=torch.float64), 1.0)
    background = views[0].mean_color()
    return Photographs(name, *views, [], [], normalization, None, background)


def _open_real_scene(path: Path, side: int, inputs: int, targets: int) -> Photographs:
    # The photographs are too small for the check of the cameras: its warning is dropped.
    limits = {"views": inputs, "held_out_every": HELD_OUT_EVERY, "max_held_out": targets}
    return open_photographs(path, side, side, **limits, say=lambda _: None)


def _without_depths(views: Views) -> Views:
    return replace(views, depths=None, masks=None)


def select_inputs(scene: Photographs, views: int | None, side: int | None) -> Photographs:
    """Select evenly spaced input views, resize them to side x side pixels, and normalize anew.

    Depths are dropped. A scene with fewer than `views` input views keeps them all; one for which
    `views` or `side` is None is returned as it is.
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
    """Measure the settings of a family on a scene; return a row for each.

    Settings with a limit in seconds run once, all others take turns in rounds. Networks run on the
    device, refinements on the CPU. `advance` is called after each of the `count_runs` runs. The row
    of a variant that cannot render this scene has the reason in "not_measured", and no numbers.
    """
    base = settings[BASE]
    family_device = CPU if isinstance(base, Refined) else device
    views = {name: getattr(scene, name).to(family_device) for name in ("inputs", "held_out")}
    scene = replace(scene, **views)
    renderings, measurements, absent = {}, {}, {}
    meters = {name: CostMeter(family_device) for name in settings}

    def run(name: str) -> dict[str, float]:
        meters[name].start()
        renderings[name] = renderers[name](scene)
        meters[name].stop()
        advance()
        return {"seconds": meters[name].seconds[-1]}

    once = runs_once(base)
    if once:  # a step to warm up, which compiles the kernels
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
    exact_images = {repr(base): renderings[BASE].images}
    rows = []
    for name, setting in settings.items():
        row = {"setting": name, "values": asdict(setting), "not_measured": absent.get(name)}
        empty = ("seconds", "over_base", "error", "psnr", "ssim", "lpips", "gaussians", "peak_gb")
        row |= dict.fromkeys(empty)
        if name in measurements:
            seconds, base_seconds = (measurements[n].seconds["seconds"] for n in (name, BASE))
            ratios = [a / b for a, b in zip(seconds, base_seconds, strict=True)]
            row |= {"seconds": summarize(seconds), "over_base": summarize(ratios)}
            row["gaussians"] = renderings[name].num_gaussians
            row["peak_gb"] = max(meters[name].gb, default=None)
            exact = base
            if isinstance(setting, FeedForward):
                exact = replace(base if setting.trained else setting, precision=EXACT)
            if exact != setting:
                key = repr(exact)
                if key not in exact_images:
                    exact_images[key] = exact.prepare(refinement, device)(scene).images
                row["error"] = {
                    "decibels": measure_psnr(renderings[name].images, exact_images[key])
                }
            if setting.trained:
                metrics = protocol.image_metrics(renderings[name].images, scene.held_out, lpips)
                row |= {metric: values.mean().item() for metric, values in metrics.items()}
        rows.append(row | ({"noise": NOISE_OF_SECONDS} if once else {}))
    return rows


def runs_once(base: Setting) -> bool:
    """Return whether this base, and so each variant, runs once: its limit is in seconds."""
    return isinstance(base, Refined) and base.seconds is not None


def count_runs(settings: Mapping[str, Setting], repeats: int) -> int:
    """Count the runs of all settings on a scene: one each, or a trial, a warm-up and the rounds."""
    return len(settings) * (1 if runs_once(settings[BASE]) else 2 + repeats)


def measure_psnr(image: Tensor, exact: Tensor) -> float:
    """Return the PSNR of all images together, clamped to [0, 1], in dB."""
    error = image.double().clamp(0, 1) - exact.double().clamp(0, 1)
    return -10 * error.square().mean().clamp_min(MIN_SQUARED_ERROR).log10().item()


def measure(options: DictConfig, console: Console) -> Result:
    """Render the held-out views of `options.pareto.scenes` with every setting.

    The settings of a family take turns on a scene, in `options.repeats` rounds; those with a limit
    in seconds run once.

    Returns:
        "rows": one for each family, scene and setting, with None for what was not measured.
        "seconds", and "over_base", their ratio to those of the base in the same round; "error", the
        "decibels" of the images against the exact ones; the metrics against the photographs;
        "gaussians", their number; "peak_gb", the largest peak memory of all runs.
        "not_measured": the reason for everything that was not measured.
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
    pairs = [
        (name, f) for name in scenes for f in families if name in (config[f]["scenes"] or scenes)
    ]
    total = sum(count_runs(families[family], options.repeats) for _, family in pairs)
    with Progress(console=console, transient=True) as bars:
        advance = partial(bars.advance, bars.add_task("measuring", total=total))
        for name, family in pairs:
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


def average_scenes(rows: Sequence[Result]) -> list[Result]:
    """Average each setting of each family over the scenes on which it was measured.

    Returns:
        Rows with the means, None for what was measured on no scene. "over_base" is a geometric
        mean; "lost" is the PSNR of the base minus that of the setting; "busy" is True if the
        machine was busy on any scene.
    """
    bases = {(row["family"], row["scene"]): row for row in rows if row["setting"] == BASE}
    means = []
    for (family, name), group in _group_rows(rows, "family", "setting").items():
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


def _group_rows(rows: Sequence[Result], *names: str) -> dict[tuple[str, ...], list[Result]]:
    groups: dict[tuple[str, ...], list[Result]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def tables(results: Result) -> list[Table]:
    """Show the settings of each family on each scene, then their means over the scenes."""
    absent = "\n".join(f"not measured: {k}, {why}" for k, why in results["not_measured"].items())
    notes = "\n".join(filter(None, (machine_note(results), NOTES, absent)))
    scenes = _group_rows(results["rows"], "family", "scene").items()
    shown = [make_table(f"{TITLES[name]}, {scene}", ROWS, rows) for (name, scene), rows in scenes]
    for (name,), rows in _group_rows(average_scenes(results["rows"]), "family").items():
        shown.append(make_table(f"{TITLES[name]}, means over scenes", MEANS, rows, notes))
    return shown


def plot(results: Result) -> Figure:
    """Plot the mean PSNR of each family, or its error if untrained, against mean seconds."""
    families = _group_rows(average_scenes(results["rows"]), "family")
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
    "setting": text_column("{setting}"),
    "ms": median_iqr_column("seconds"),
    "/ base": median_iqr_column("over_base", "{:.2f}", unit=1.0),
    "PSNR": number_column("psnr", "{:.2f}"),
    "LPIPS": number_column("lpips", "{:.3f}"),
    "Gaussians": number_column("gaussians", "{:,}"),
    "GB": number_column("peak_gb", "{:.2f}"),
    "error\ndB": number_column("error.decibels", "{:.1f}"),
}
MEANS: Columns = {
    "setting": text_column("{setting}"),
    "scenes": text_column("{scenes}"),
    "ms": number_column("seconds", "{:.0f}", unit=1e-3),
    "": lambda row: "busy" if row["busy"] else "",
    "/ base": number_column("over_base", "{:.2f}"),
    "PSNR": number_column("psnr", "{:.2f}"),
    "PSNR\nlost": number_column("lost", "{:+.2f}"),
    "LPIPS": number_column("lpips", "{:.3f}"),
    "error\ndB": number_column("error", "{:.1f}"),
}
