"""Run time against error: every knob of a prediction and of a refinement, one at a time.

A setting renders all held-out views of a scene from photographs in memory. A knob is what a
setting changes of the base of its family.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, partial
from pathlib import Path
from statistics import fmean
from typing import Any

import matplotlib
import torch
import torch.nn.functional as F
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lpips import LPIPS
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table
from torch import Tensor

from asysplat import load
from asysplat.benchmark import timing
from asysplat.benchmark.compare import DECIBELS, LPIPS_DISTANCE, TIME, Watched
from asysplat.benchmark.options import CPU, PRECISIONS, check_names, find_device
from asysplat.benchmark.table import Columns, at, machine_note, make_table, number, spread, text
from asysplat.benchmark.timing import Measurement, Result, rise_gb, seconds_of, summary
from asysplat.data.normalize import Normalization, normalize
from asysplat.data.procedural import ProceduralScene
from asysplat.data.procedural.scene import split_seed
from asysplat.data.selection.views import spread as select_evenly
from asysplat.data.selection.views import uniform_selection
from asysplat.errors import InputError, input_error_behind
from asysplat.evaluation.lpips import load_lpips
from asysplat.evaluation.protocol import Protocol
from asysplat.models.network import Network
from asysplat.refinement import RefinementSettings, mean_color, merge_to_limit, refine
from asysplat.refinement.init import INITS, initial_gaussians
from asysplat.refinement.photographs import Photographs, open_photographs
from asysplat.rendering import INRIA, render
from asysplat.report.front import draw_front, pareto_front
from asysplat.report.style import FAINT, OURS, STYLE
from asysplat.scene import Views

BASE = "base"  # the setting that each knob changes
EXACT = "fp64"
SIZES = {"inputs": 16, "targets": 4}  # most views of a scene, unless its family says otherwise
FRAMES = 96  # of a procedural scene
PROCEDURAL = {"room": "rooms", "outdoors": "outdoors"}  # test scenes, by their `places`
REAL = ("fern", "fox", "hololens-000", "mydesk")  # folders of data/; others may be there, too
HELD_OUT_EVERY = 8
MIN_SQUARED_ERROR = 1e-20  # of images that are equal: 200 dB, as JSON has no infinity
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
    "networks": "Other layers, untrained",
    "refined": "Refined",
    "reconstruct": "Refined for some seconds",
}
QUALITIES = {  # higher is better
    "psnr": "PSNR against photographs, dB",
    "error_decibels": "PSNR against the exact images, dB",
}
NOTES = """\
-: not measured; photographs in memory to all held-out views; / base: in the same round, in turns
error: of images in [0, 1] against the base in float64, of other layers against their own, of \
refinements against the base"""

RenderScene = Callable[[Photographs], Tensor]  # all held-out views [V, 3, H, W]


@dataclass(frozen=True)
class FeedForward:
    """A network's prediction, with some of its Gaussians merged or left out, rendered."""

    views: int  # input views
    side: int  # of the input views, pixels
    checkpoint: str | None = "shipped"  # see `load`; None: untrained
    overrides: Sequence[str] = ()  # of train.py; with a checkpoint they may change no weights
    precision: str = "fp32"  # of the network: fp32, bf16 by autocast, or fp64, for all else too
    min_opacity: float = 0.0  # below which Gaussians are dropped
    cell: float | None = None  # pixels: Gaussians in a cell are merged; None: none are
    max_gaussians: int | None = None  # cells grow until so few are left
    sh_degree: int | None = None  # of the rendered colors; None: all
    views_at_once: int | None = None  # rendered; None: all
    convention: Mapping[str, float] = field(default_factory=dict)  # fields of `Convention`

    def __post_init__(self):
        check_names("precision", [self.precision], [*PRECISIONS, EXACT])
        _check_whole(self, "views", "side", "max_gaussians", "views_at_once")
        if self.convention:
            check_names("convention", self.convention, [each.name for each in fields(INRIA)])

    @property
    def trained(self) -> bool:
        return self.checkpoint is not None

    def prepare(self, refinement: DictConfig, device: torch.device) -> RenderScene:
        """Load the network; return the function that renders a scene on the device.

        Raises:
            InputError: no such file or override, or weights that do not fit.
        """
        net = _load_network(self.checkpoint, tuple(self.overrides))
        dtype = torch.float64 if self.precision == EXACT else torch.float32
        if (device, dtype) != (CPU, torch.float32):
            net = deepcopy(net).to(device, dtype)
        return partial(self._render, net, dtype)

    @torch.no_grad()
    def _render(self, net: Network, dtype: torch.dtype, scene: Photographs) -> Tensor:
        scene = select_inputs(scene, self.views, self.side)
        inputs, targets = scene.inputs.to(dtype), scene.held_out.to(dtype)
        half = PRECISIONS.get(self.precision) == torch.bfloat16
        with torch.autocast(inputs.images.device.type, torch.bfloat16, enabled=half):
            gaussians = net(inputs)
        gaussians = gaussians.to(dtype)
        if self.min_opacity > 0:
            gaussians = gaussians.keep(gaussians.opacities >= self.min_opacity)
        if self.cell is not None or self.max_gaussians is not None:
            limit = self.max_gaussians or gaussians.num_gaussians
            gaussians = merge_to_limit(gaussians, inputs.cameras, self.cell or 1.0, limit)
        options = {"sh_degree": self.sh_degree, "views_at_once": self.views_at_once}
        options |= {"depth": False, "convention": replace(INRIA, **self.convention)}
        return render(gaussians, targets.cameras, mean_color(inputs), **options).image


@dataclass(frozen=True)
class Refined:
    """A start and a refinement of so many steps or seconds, rendered."""

    views: int | None  # input views; None: all, as they are
    side: int | None  # of the input views, pixels; None with `views`
    steps: int | None = None  # every round gives the same bits; 0: the start alone
    seconds: float | int | None = None  # in place of steps
    init: str = "plane_sweep"  # see `initial_gaussians`; the network is the shipped one
    refinement: Mapping[str, Any] = field(default_factory=dict)  # over the file of conf/refinement

    trained = True

    def __post_init__(self):
        check_names("init", [self.init], INITS)
        _check_whole(self, "views", "side")
        _check_whole(self, "steps", minimum=0)
        if (self.steps is not None) == (0 < (self.seconds or 0) < math.inf):
            raise InputError(
                f"steps={self.steps} and seconds={self.seconds}: give one of them, above 0."
            )

    def prepare(self, refinement: DictConfig, device: torch.device) -> RenderScene:
        """Read the settings; return the function that renders a scene on the CPU.

        Raises:
            InputError: an unknown setting or one out of range.
        """
        try:
            settings = instantiate(OmegaConf.merge(refinement, dict(self.refinement)))
        except (OmegaConfBaseException, InstantiationException, TypeError, ValueError) as error:
            message = f"{self.refinement} are no settings of a refinement."
            raise InputError(str(input_error_behind(error) or message)) from None
        net = _load_network("shipped", ()) if self.init == "network" else None
        return partial(self._render, settings, net)

    def _render(
        self, settings: RefinementSettings, net: Network | None, scene: Photographs
    ) -> Tensor:
        scene = select_inputs(scene, self.views, self.side)
        gaussians = initial_gaussians(self.init, scene, settings.max_gaussians, net)
        background = mean_color(scene.inputs)
        if self.steps != 0:
            limit = {"steps": self.steps, "seconds": self.seconds}
            gaussians = refine(gaussians, scene.inputs, settings, background=background, **limit)
        with torch.no_grad():
            return render(gaussians, scene.held_out.cameras, background, depth=False).image


FAMILIES = dict.fromkeys(("feed_forward", "networks"), FeedForward)
FAMILIES |= dict.fromkeys(("refined", "reconstruct"), Refined)
Setting = FeedForward | Refined


def _check_whole(setting: Setting, *names: str, minimum: int = 1) -> None:
    for name in names:
        value = getattr(setting, name)
        if value is not None and (type(value) is not int or value < minimum):
            raise InputError(f"{name}={value}: give a whole number from {minimum}.")


@cache
def _load_network(checkpoint: str | None, overrides: tuple[str, ...]) -> Network:
    torch.manual_seed(0)
    return load(checkpoint, overrides)


def find_families(config: Mapping[str, Any]) -> dict[str, dict[str, Setting]]:
    """Return the settings of each family of `config.families`: the base, and those of its knobs.

    Raises:
        InputError: an unknown family, knob or field of a setting, or a value out of range.
    """
    check_names("pareto.families", config["families"], FAMILIES)
    families = {}
    for family in config["families"]:
        kind, base = FAMILIES[family], config[family]["base"]
        families[family] = {}
        for name, changes in ({BASE: {}} | (config[family]["knobs"] or {})).items():
            where = f"pareto.{family}.{name}"
            if not isinstance(changes, Mapping):
                raise InputError(f"{where}={changes} is no setting: give {{name: value}}.")
            check_names(where, base | changes, [each.name for each in fields(kind)])
            try:
                families[family][name] = kind(**(base | changes))
            except (InputError, TypeError) as error:
                raise InputError(f"{where}: {error}") from error
    if (chosen := config["knobs"]) != "all":
        names = dict.fromkeys(name for settings in families.values() for name in settings)
        check_names("pareto.knobs", chosen, [*names, "all"])
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
    selected = select_evenly(range(cameras.num_views), min(views, cameras.num_views))
    inputs = _without_depths(scene.inputs.select(selected))
    if side != cameras.height:
        images = F.interpolate(inputs.images, (side, side), mode="area")
        inputs = Views(inputs.cameras.resized(side, side), images)
    inputs, targets, _ = normalize(inputs, _without_depths(scene.held_out))
    return replace(scene, inputs=inputs, held_out=targets, points=None)


def measure_scene(
    scene: Photographs,
    settings: Mapping[str, Setting],
    renderers: Mapping[str, RenderScene],
    protocol: Protocol,
    lpips: LPIPS | None,
    refinement: DictConfig,
    device: torch.device,
    repeats: int,
) -> list[Result]:
    """Measure all settings in turns, those with a limit in seconds once; return a row for each.

    Args:
        renderers: of each setting.
        lpips: see `load_lpips`; None: no LPIPS.
        refinement: a file of conf/refinement.
        device: of the networks; refinements are on the CPU.

    Raises:
        InputError: the setting BASE cannot render this scene. Of another that cannot, all
            numbers are None, and "not_measured" says why.
    """
    base = settings[BASE]
    own_device = CPU if isinstance(base, Refined) else device
    views = {name: getattr(scene, name).to(own_device) for name in ("inputs", "held_out")}
    scene = replace(scene, **views)
    images, measurements, absent = {}, {}, {}

    def run(name: str) -> None:
        images[name] = renderers[name](scene)

    once = isinstance(base, Refined) and base.seconds is not None
    if once:  # compiles kernels
        replace(base, seconds=None, steps=1).prepare(refinement, CPU)(scene)
    for name in settings:
        run_once = partial(run, name)
        try:
            if once:
                seconds = {"seconds": [seconds_of(run_once, own_device)]}
                measurements[name] = Measurement(dict, {"peak_gb": None}, seconds)
            else:
                costs = {"peak_gb": max(0.0, rise_gb(run_once, own_device))}
                timer = partial(seconds_of, run_once, own_device)
                measurements[name] = Measurement(lambda t=timer: {"seconds": t()}, costs)
        except InputError as error:
            if name == BASE:
                raise
            absent[name] = str(error)
    if not once:
        timing.time_in_rounds(list(measurements.values()), repeats)
    exact_images = {repr(base): images[BASE]}
    rows = []
    for name, setting in settings.items():
        row = {"setting": name, "values": asdict(setting), "not_measured": absent.get(name)}
        row |= dict.fromkeys(("seconds", "over_base", "peak_gb", "error", "psnr", "ssim", "lpips"))
        if name in measurements:
            timed, image = measurements[name], images[name]
            own, of_base = (m.seconds["seconds"] for m in (timed, measurements[BASE]))
            ratios = [a / b for a, b in zip(own, of_base, strict=True)]
            row |= {"seconds": summary(own), "over_base": summary(ratios)} | timed.row
            exact = base
            if isinstance(setting, FeedForward):
                exact = replace(base if setting.trained else setting, precision=EXACT)
            if exact != setting:
                key = repr(exact)
                if key not in exact_images:
                    exact_images[key] = exact.prepare(refinement, device)(scene)
                row["error"] = image_error(image, exact_images[key])
            if setting.trained:
                metrics = protocol.image_metrics(image, scene.held_out, lpips)
                row |= {metric: values.mean().item() for metric, values in metrics.items()}
        rows.append(row | ({"noise": NOISE_OF_SECONDS} if once else {}))
    return rows


def image_error(image: Tensor, exact: Tensor) -> Result:
    """Compare images, clamped to [0, 1]: decibels of the mean squared error, and the largest."""
    error = image.double().clamp(0, 1) - exact.double().clamp(0, 1)
    squared = error.square().mean().clamp_min(MIN_SQUARED_ERROR)
    return {"decibels": -10 * squared.log10().item(), "max": error.abs().max().item()}


def measure(options: DictConfig, console: Console) -> Result:
    """Render the held-out views of `options.pareto.scenes` with every knob.

    By a network's prediction ("feed_forward"), by untrained networks of other layers
    ("networks"), by a refinement of so many steps ("refined") or seconds ("reconstruct"). All
    settings of a family take turns on a scene, in `options.repeats` rounds; those of seconds run
    once.

    Returns:
        "rows": one for each family, scene and setting: "seconds", their ratio to the base's of the
        same round "over_base", "peak_gb" above what was held before, "error" of the images
        against the exact ones ("decibels", "max"), and metrics against the photographs; None for
        what was not measured. "settings": the means, see `summarize`. "not_measured": what, and
        why.
    """
    config = OmegaConf.to_container(options.pareto, resolve=True)
    shared = Path(config["shared"])
    families = find_families(config)
    protocol = instantiate(options.metrics)
    lpips = load_lpips(protocol.lpips_net, shared / "weights")
    device = find_device(options.device)
    renderers = {
        family: {n: each.prepare(options.refinement, device) for n, each in settings.items()}
        for family, settings in families.items()
    }
    scenes, absent = find_scenes(config["scenes"], shared / "data")
    common = (protocol, lpips, options.refinement, device, options.repeats)
    if lpips is None:
        absent["LPIPS"] = f"{shared / 'weights'} has no weights of its backbone"
    if not torch.cuda.is_available():
        absent["a GPU"] = "there is none"
    rows: list[Result] = []
    for name, open_scene in scenes.items():
        for family, settings in families.items():
            if name not in (config[family]["scenes"] or scenes):
                continue
            sizes = {"side": config["side"]} | SIZES | (config[family].get("photographs") or {})
            with console.status(f"{name}: {len(settings)} settings, {family}"):
                found = measure_scene(open_scene(**sizes), settings, renderers[family], *common)
            console.print(f"{name}: {family}, {len(found)} settings", highlight=False)
            where = {"family": family, "scene": name, "side": sizes["side"]}
            rows += [where | row for row in found]
    for row in [row for row in rows if row["not_measured"]]:
        absent["{family}, {scene}, {setting}".format(**row)] = row["not_measured"]
    results = {"protocol": protocol.sentences(), "not_measured": absent}
    return results | {"rows": rows, "settings": summarize(rows)}


def summarize(rows: Sequence[Result]) -> list[Result]:
    """Average each setting of each family over the scenes that it was measured on.

    Returns:
        "over_base" is a geometric mean; "lost" is the PSNR below the base's, "most_lost" that of
        the worst scene; "error_max" and "peak_gb" are the largest; "on_front" whether no other
        setting of the family has both less seconds and a higher PSNR (a lower error, where there
        is no PSNR). None for what was measured on no scene.
    """
    bases = {(row["family"], row["scene"]): row for row in rows if row["setting"] == BASE}
    means = [
        {"family": family, "setting": name, **_means(group, bases)}
        for (family, name), group in _grouped(rows, "family", "setting").items()
    ]
    for own in _grouped(means, "family").values():
        quality = next((name for name in QUALITIES if points(own, name)), None)
        front = [name for name, *_ in pareto_front(points(own, quality), "higher")]
        for row in own:
            row["on_front"] = row["setting"] in front
    return means


def _means(group: Sequence[Result], bases: Mapping[tuple[str, str], Result]) -> Result:
    timed_rows = [row for row in group if row["seconds"]]

    def values(path: str) -> list[float]:
        return [value for row in timed_rows if (value := at(row, path)) is not None]

    rows = [row for row in timed_rows if row["psnr"] is not None]
    lost = [bases[row["family"], row["scene"]]["psnr"] - row["psnr"] for row in rows]
    means = {
        "seconds": values("seconds.median"),
        "psnr": values("psnr"),
        "lost": lost,
        "lpips": values("lpips"),
        "error_decibels": values("error.decibels"),
        "over_base": list(map(math.log, values("over_base.median"))),
    }
    means = {name: fmean(numbers) if numbers else None for name, numbers in means.items()}
    if means["over_base"] is not None:
        means["over_base"] = math.exp(means["over_base"])
    largest = {"most_lost": lost, "error_max": values("error.max"), "peak_gb": values("peak_gb")}
    largest = {name: max(numbers, default=None) for name, numbers in largest.items()}
    busy = any(row["seconds"]["busy"] for row in timed_rows)
    return {"scenes": len(timed_rows), **means, **largest, "busy": busy}


def points(rows: Sequence[Result], quality: str | None) -> list[tuple[str, float, float]]:
    """Return name, seconds and quality of the settings that have both."""
    names = ("setting", "seconds", quality)
    found = [tuple(row.get(name) for name in names) for row in rows]
    return [point for point in found if None not in point]


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
    families = _grouped(results["settings"], "family").items()
    shown = [make_table(f"{TITLES[name]}, {scene}", ROWS, rows) for (name, scene), rows in scenes]
    for (name,), rows in families:
        shown.append(make_table(f"{TITLES[name]}, means over scenes", MEANS, rows, notes))
    return shown


def plot(results: Result) -> Figure:
    """Plot each quality against seconds: a column for each family, the front drawn."""
    families = _grouped(results["settings"], "family")
    shown = [name for name in QUALITIES if points(results["settings"], name)]
    with matplotlib.rc_context(STYLE):
        size = (1.0 + 5.2 * len(families), 0.8 + 4.2 * len(shown))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(shown), len(families), squeeze=False)
        for column, (family,) in enumerate(families):
            for axes, quality in zip(grid[:, column], shown, strict=True):
                axes.set(title=TITLES[family], xlabel="seconds", ylabel=QUALITIES[quality])
        for column, rows in enumerate(families.values()):
            busy = [row["setting"] for row in rows if row["busy"]]
            for axes, quality in zip(grid[:, column], shown, strict=True):
                if found := points(rows, quality):
                    axes.set_xscale("log")
                    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
                    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                    axes.xaxis.set_minor_formatter(NullFormatter())
                    draw_front(axes, found, "higher", OURS, busy)
                else:
                    style = {"color": FAINT, "ha": "center", "transform": axes.transAxes}
                    axes.text(0.5, 0.5, "not measured", **style)
                    axes.set_axis_off()
        note = "hollow: measured while the machine was busy; crowded names are left out"
        figure.supxlabel(note, fontsize=9, color=FAINT)
    return figure


ROWS: Columns = {
    "setting": text("{setting}"),
    "ms": spread("seconds"),
    "/ base": spread("over_base", "{:.2f}", unit=1.0),
    "PSNR": number("psnr", "{:.2f}"),
    "LPIPS": number("lpips", "{:.3f}"),
    "error\ndB": number("error.decibels", "{:.1f}"),
    "error\nmax": number("error.max", "{:.1e}"),
    "MB": number("peak_gb", "{:.0f}", unit=1e-3),
}
MEANS: Columns = {
    "setting": text("{setting}"),
    "front": lambda row: "*" if row["on_front"] else "",
    "scenes": text("{scenes}"),
    "ms": number("seconds", "{:.0f}", unit=1e-3),
    "": lambda row: "busy" if row["busy"] else "",
    "/ base": number("over_base", "{:.2f}"),
    "PSNR": number("psnr", "{:.2f}"),
    "PSNR\nlost": number("lost", "{:+.2f}"),
    "at\nmost": number("most_lost", "{:+.2f}"),
    "LPIPS": number("lpips", "{:.3f}"),
    "error\ndB": number("error_decibels", "{:.1f}"),
    "error\nmax": number("error_max", "{:.1e}"),
    "MB": number("peak_gb", "{:.0f}", unit=1e-3),
}
