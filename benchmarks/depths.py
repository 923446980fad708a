"""How right the plane sweep is where the truth is known: README's scene, rooms and outdoors."""

import time
from collections.abc import Iterator

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from asysplat.data import ProceduralScene
from asysplat.data.procedural.scene import split_seed
from asysplat.evaluation.metrics import abs_rel, delta1
from asysplat.models import PlaneSweep
from asysplat.refinement.init import MIN_CONFIDENCE
from asysplat.scene import Views
from benchmarks.compare import ERROR, TrackedMetrics
from benchmarks.table import machine_text, make_table, number_column, text_column
from benchmarks.timing import Result

TRACKED = TrackedMetrics(names=("scene",), must_match=("views",), kinds={"absrel": ERROR})
SIDE = 128  # pixels of a depth map
COUNT = 4  # test scenes of each kind
NOTES = """\
AbsRel and share within a quarter at all pixels of all views, 128x128; sure: share of pixels whose \
depth a refinement keeps, and AbsRel there"""


def scenes() -> Iterator[tuple[str, Views]]:
    """Make the scenes: every 8th view of README's 48 left out, and 16 of 96 views of the others."""
    readme = ProceduralScene(seed=7, height=2 * SIDE, width=2 * SIDE, num_images=48)
    yield "README's", readme.views([index for index in range(48) if index % 8])
    for places in ("rooms", "outdoors"):
        for number in range(COUNT):
            seed = split_seed("test", number)
            scene = ProceduralScene(seed, SIDE, SIDE, num_images=96, places=places)
            yield f"{places} {number}", scene.views(range(0, 96, 6))


def measure(options: DictConfig, console: Console) -> Result:
    """Sweep all scenes.

    Returns:
        "rows": for each scene the errors of its depths, and the seconds of its sweep.
    """
    made = list(scenes())
    _row(*made[-1])  # compiles the kernels
    return {"rows": [_row(name, views) for name, views in made]}


def _row(name: str, views: Views) -> Result:
    clock = time.perf_counter()
    sweep = PlaneSweep().sweep(views.map(lambda tensor: tensor[None]))
    seconds = time.perf_counter() - clock
    target = views.resized(SIDE, SIDE).known_depths
    assert target is not None
    depth, sure = 1 / sweep.inverse_depth[0].clamp_min(1e-6), sweep.confidence[0] > MIN_CONFIDENCE
    error = (depth - target).abs() / target
    return {
        "scene": name,
        "views": views.num_views,
        "absrel": abs_rel(depth, target).mean().item(),
        "delta1": delta1(depth, target).mean().item(),
        "sure": sure.float().mean().item(),
        "absrel_sure": error[sure & (target > 0)].mean().item(),
        "seconds": seconds,
    }


def tables(results: Result) -> list[Table]:
    """Show each scene, and the means of each kind."""
    rows = list(results["rows"])
    for places in ("rooms", "outdoors"):
        those = [row for row in results["rows"] if row["scene"].startswith(places)]
        if those:
            keys = those[0].keys() - {"scene"}
            means = {key: sum(row[key] for row in those) / len(those) for key in keys}
            rows.append({"scene": f"{places}, mean"} | means)
    notes = f"{NOTES}\n{machine_text(results)}"
    return [make_table("Depths of the plane sweep", COLUMNS, rows, notes)]


COLUMNS = {
    "scene": text_column("{scene}"),
    "views": number_column("views", "{:.0f}"),
    "AbsRel": number_column("absrel", "{:.3f}"),
    "delta<1.25": number_column("delta1", "{:.3f}"),
    "sure": number_column("sure", "{:.0%}"),
    "AbsRel there": number_column("absrel_sure", "{:.3f}"),
    "s": number_column("seconds", "{:.2f}"),
}
