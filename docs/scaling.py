"""Fill the tables of docs/scaling.md from docs/results.

python docs/scaling.py
"""

import json
import re
from pathlib import Path
from statistics import median
from typing import Any

REPO = Path(__file__).resolve().parents[1]
RESULTS, PAGE = REPO / "docs" / "results", REPO / "docs" / "scaling.md"

# The paper's stages at 32 input and 8 target views: side lengths, global batch, steps.
STAGES = {1: (256, 256, 256, 60_000), 2: (512, 512, 64, 10_000), 3: (544, 960, 64, 10_000)}
INPUTS, TARGETS = 32, 8
PASSES = 3  # a step's products over those of its forward pass
PEAK = 989.4e12  # FLOP/s of an H100 or H200 in bf16, of NVIDIA's data sheet: nothing is faster
SCENES, PHOTOGRAPHS = 10_000, 350  # the second is assumed
PARAMETER_BYTES = 4
GPUS = (8, 32, 256)
FILES = ("model", "growth/model", "render", "scaling")  # of docs/results


def tables() -> dict[str, str]:
    """Make every table of the page, by name."""
    found = {name: json.loads((RESULTS / f"{name}.json").read_text()) for name in FILES}
    makers = (views_table, parts_table, render_table, stages_table)
    makers += (gpus_table, photographs_table, reading_table, disk_table)
    return {maker.__name__.removesuffix("_table"): maker(found) for maker in makers}


def views_table(found: dict[str, Any]) -> str:
    """Show a forward pass against views and resolution, and how fast it was on a CPU."""
    seconds = {row["views"]: row["forward"]["median"] for row in found["growth/model"]["rows"]}
    rows = []
    for row in found["scaling"]["network"]:
        measured = seconds.get(row["views"]) if row["height"] == 256 else None
        rows.append(
            [
                f"{row['views']} of {row['height']}x{row['width']}",
                f"{row['gflops_true'] / 1e3:.2f}",
                f"{row['activation_gb']:.1f}",
                f"{row['gaussians'] / 1e6:.2f}",
                "not measured" if measured is None else f"{measured:.1f}",
                "" if measured is None else f"{row['gflops_true'] / measured:.0f}",
            ]
        )
    head = ("views", "TFLOP", "kept, GB in fp32", "million Gaussians", "CPU, s", "GFLOP/s")
    return markdown(head, rows)


def parts_table(found: dict[str, Any]) -> str:
    """Show what a forward pass of 32 views of 256x256 goes into, and what each part grows by."""
    small, large = (row["components"] for row in found["growth/model"]["rows"][::3])
    parts = found["model"]["rows"][0]["components"]
    whole = sum(part["seconds"]["median"] for part in parts.values())
    rows = [
        [
            name,
            f"{part['seconds']['median'] / whole:.0%}",
            f"{part['seconds']['median'] / part['floor']:.2f}",
            f"{large[name]['seconds']['median'] / small[name]['seconds']['median']:.1f}",
        ]
        for name, part in parts.items()
    ]
    return markdown(("part", "of the seconds", "over its products", "8 to 64 views, times"), rows)


def render_table(found: dict[str, Any]) -> str:
    """Show what rendering a step's targets takes on a CPU, beside a step of the network."""
    step = found["model"]["rows"][1]["step"]["median"]  # of 32 views of 256x256, in bf16
    shown = {"524k": f"{TARGETS} of 256x256", "4M": f"{TARGETS} of 540x960"}
    rows = []
    for row in found["render"]["rows"]:
        if row["backend"] == "cpu" and row["without"] is None and row["scene"] in shown:
            seconds = TARGETS * (row["forward"]["median"] + row["backward"]["median"])
            share = f"{seconds / step:.1%}" if row["height"] == 256 else "not measured"
            count = f"{row['gaussians'] / 1e6:.2f}"
            rows.append([shown[row["scene"]], count, f"{seconds:.1f}", share])
    head = ("targets", "million Gaussians", "CPU, s, with gradients", "of the network's step")
    return markdown(head, rows)


def stages_table(found: dict[str, Any]) -> str:
    """Show what each of the paper's stages computes at least."""
    flops = {(row["height"], row["width"]): row for row in network_of(found, INPUTS)}
    rows, total = [], 0.0
    for stage, (height, width, batch, steps) in STAGES.items():
        step = PASSES * 1e9 * flops[height, width]["gflops_true"] * batch
        total += step * steps
        read = batch * (INPUTS + TARGETS) * steps
        rows.append(
            [
                f"{stage}: {height}x{width}, {steps:,} steps of {batch}",
                f"{step / 1e15:.2f}",
                f"{step * steps / 1e18:.1f}",
                f"{step * steps / PEAK / 3600:,.0f}",
                f"{read / 1e6:.0f}",
                f"{read / (SCENES * PHOTOGRAPHS):.0f}",
            ]
        )
    rows.append(["all", "", f"{total / 1e18:.1f}", f"{total / PEAK / 3600:,.0f}", "", ""])
    head = ("stage", "PFLOP a step", "EFLOP", "GPU hours at the peak", "million photographs read")
    return markdown((*head, "times each"), rows)


def gpus_table(found: dict[str, Any]) -> str:
    """Show what stage 1 asks of each of so many GPUs, and of what feeds them, at the peak."""
    height, _, batch, _ = STAGES[1]
    row = next(r for r in network_of(found, INPUTS) if r["height"] == height)
    step = PASSES * 1e9 * row["gflops_true"] * batch
    reading = next(r for r in found["scaling"]["reading"] if r["height"] == height)["seconds"]
    sent = 2 * PARAMETER_BYTES * row["parameters"]
    file = published_bytes(found)
    rows = []
    for gpus in GPUS:
        seconds = step / PEAK / gpus
        photographs = batch * (INPUTS + TARGETS) / seconds
        rows.append(
            [
                f"{gpus}",
                f"{batch // gpus}",
                f"{1e3 * seconds:.0f}",
                f"{sent * (gpus - 1) / gpus / 1e9:.2f}",
                f"{sent * (gpus - 1) / gpus / seconds / 1e9:.1f}",
                f"{photographs / 1e3:.1f}",
                f"{photographs * reading / gpus:.0f}",
                f"{photographs * file / 1e9:.1f}",
            ]
        )
    head = ("GPUs", "scenes each", "ms a step, at least", "GB sent by each", "GB/s")
    head += ("thousand photographs/s", "cores for each GPU", "GB/s of JPEG")
    return markdown(head, rows)


def photographs_table(found: dict[str, Any]) -> str:
    """Show the bytes of the real photographs at hand."""
    rows = []
    for row in found["scaling"]["photographs"]:
        pixels = row["size"][0] * row["size"][1]
        rows.append(
            [
                row["scene"],
                f"{row['size'][0]}x{row['size'][1]}, {row['format'].removeprefix('.')}",
                f"{row['file_bytes'] / 1e3:.0f}",
                f"{row['file_bytes'] / pixels:.2f}",
                f"{row['file_bytes'] / pixels * 540 * 960 / 1e3:.0f}",
                f"{row['jpeg_bytes_256'] / 1e3:.1f}",
            ]
        )
    head = ("scene", "files", "kB each", "bytes a pixel", "540x960 at that, kB")
    return markdown((*head, "256x256 as JPEG 90, kB"), rows)


def reading_table(found: dict[str, Any]) -> str:
    """Show the processor's time for a JPEG of 540x960 to become a view."""
    rows = [
        [
            f"{row['height']}x{row['width']}",
            f"{1e3 * row['seconds']:.1f}",
            f"{1 / row['seconds']:.0f}",
            f"{(INPUTS + TARGETS) * row['seconds']:.2f}",
        ]
        for row in found["scaling"]["reading"]
    ]
    head = ("view", "ms of a core", "photographs/s of a core", "s of a core for a scene of 40")
    return markdown(head, rows)


def disk_table(found: dict[str, Any]) -> str:
    """Show what 10,000 scenes take, and a hundred times as many, in every form they are kept in."""
    small = median(row["jpeg_bytes_256"] for row in found["scaling"]["photographs"])
    forms = {
        "JPEG for 540x960 (bytes a pixel as above)": published_bytes(found),
        "JPEG 90 of 256x256": small,
        "the cache's arrays of 256x256": 3 * 256 * 256,
        "the cache's arrays of 544x960": 3 * 544 * 960,
        "disparities of 272x484": found["scaling"]["disparity_bytes"],
    }
    rows = [
        [
            name,
            f"{each / 1e3:.0f}",
            f"{each * SCENES * PHOTOGRAPHS / 1e12:.2f}",
            f"{100 * each * SCENES * PHOTOGRAPHS / 1e12:.0f}",
        ]
        for name, each in forms.items()
    ]
    return markdown(("", "kB a photograph", f"{SCENES:,} scenes, TB", "100 times, TB"), rows)


def network_of(found: dict[str, Any], views: int) -> list[dict[str, Any]]:
    """Return the rows of so many views."""
    return [row for row in found["scaling"]["network"] if row["views"] == views]


def published_bytes(found: dict[str, Any]) -> float:
    """Return the bytes of a photograph of 540x960: the median of those at hand, by the pixel."""
    rows = found["scaling"]["photographs"]
    return 540 * 960 * median(r["file_bytes"] / (r["size"][0] * r["size"][1]) for r in rows)


def markdown(head: tuple[str, ...], rows: list[list[str]]) -> str:
    """Write a table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def filled(page: str) -> str:
    """Return the page with its tables made anew."""
    made = tables()

    def fill(match: re.Match) -> str:
        return f"<!-- {match[1]} -->\n{made[match[1]]}\n<!-- end -->"

    return re.sub(r"<!-- (\w+) -->\n.*?<!-- end -->", fill, page, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
