"""Fill the tables of docs/scaling.md from docs/results.

python docs/scaling.py
"""

import json
import re
from collections.abc import Iterable
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
GRADIENT_BYTES = 4
GPUS = (8, 32, 256)
RENDERED = {"524k": f"{TARGETS} of 256x256", "4M": f"{TARGETS} of 540x960"}
NOT_MEASURED = "not measured"


def tables() -> dict[str, str]:
    """Make every table of the page, by name."""
    names = ("model", "growth/model", "render", "scaling", "machine_code")
    model, growth, render, scaling, machine_code = (
        json.loads((RESULTS / f"{name}.json").read_text()) for name in names
    )
    growth, network = growth["rows"], scaling["network"]
    cpu_seconds = {row["views"]: row["forward"]["median"] for row in growth}
    parts = model["rows"][0]["components"]
    all_parts = sum(part["seconds"]["median"] for part in parts.values())
    step_seconds = model["rows"][1]["step"]["median"]  # median of 32 views of 256x256, in bf16
    flops = {
        (row["height"], row["width"]): PASSES * 1e9 * row["gflops_true"]
        for row in network
        if row["views"] == INPUTS
    }
    files = scaling["photographs"]
    pixel_bytes = [row["file_bytes"] / (row["size"][0] * row["size"][1]) for row in files]
    jpeg_bytes = 540 * 960 * median(pixel_bytes)

    def views_row(row: dict[str, Any]) -> tuple:
        seconds = cpu_seconds.get(row["views"]) if row["height"] == 256 else None
        flops, size = row["gflops_true"], f"{row['views']} of {row['height']}x{row['width']}"
        speed = (f"{seconds:.1f}", f"{flops / seconds:.0f}") if seconds else (NOT_MEASURED, "")
        gaussians = f"{row['gaussians'] / 1e6:.2f}"
        return size, f"{flops / 1e3:.2f}", f"{row['activation_gb']:.1f}", gaussians, *speed

    def parts_row(name: str) -> tuple:
        seconds = parts[name]["seconds"]["median"]
        few, many = (growth[i]["components"][name]["seconds"]["median"] for i in (0, 3))
        return name, f"{seconds / all_parts:.0%}", f"{many / few:.1f}"

    def render_row(row: dict[str, Any]) -> tuple:
        seconds = TARGETS * (row["forward"]["median"] + row["backward"]["median"])
        share = f"{seconds / step_seconds:.1%}" if row["height"] == 256 else NOT_MEASURED
        return RENDERED[row["scene"]], f"{row['gaussians'] / 1e6:.2f}", f"{seconds:.1f}", share

    def stages_row(stage: int) -> tuple:
        height, width, batch, steps = STAGES[stage]
        step, images = flops[height, width] * batch, batch * (INPUTS + TARGETS) * steps
        name = f"{stage}: {height}x{width}, {steps:,} steps of {batch}"
        compute = f"{step / 1e15:.2f}", f"{step * steps / 1e18:.1f}"
        hours, times = f"{step * steps / PEAK / 3600:,.0f}", images / (SCENES * PHOTOGRAPHS)
        return name, *compute, hours, f"{images / 1e6:.0f}", f"{times:.0f}"

    def gpus_row(gpus: int) -> tuple:
        height, width, batch, _ = STAGES[1]
        seconds = flops[height, width] * batch / PEAK / gpus
        parameters = network[0]["parameters"]
        sent = 2 * GRADIENT_BYTES * parameters * (gpus - 1) / gpus / 1e9
        images = batch * (INPUTS + TARGETS) / seconds
        reading = next(r for r in scaling["reading"] if r["height"] == height)["seconds"]
        network_columns = f"{1e3 * seconds:.0f}", f"{sent:.2f}", f"{sent / seconds:.1f}"
        cores, gigabytes = f"{images * reading / gpus:.0f}", f"{images * jpeg_bytes / 1e9:.1f}"
        sizes = str(gpus), str(batch // gpus)
        return *sizes, *network_columns, f"{images / 1e3:.1f}", cores, gigabytes

    def photographs_row(row: dict[str, Any], each: float) -> tuple:
        size = f"{row['size'][0]}x{row['size'][1]}, {row['format'].removeprefix('.')}"
        kilobytes = f"{each * 540 * 960 / 1e3:.0f}", f"{row['jpeg_bytes_256'] / 1e3:.1f}"
        return row["scene"], size, f"{row['file_bytes'] / 1e3:.0f}", f"{each:.2f}", *kilobytes

    def reading_row(row: dict[str, Any]) -> tuple:
        seconds, size = row["seconds"], f"{row['height']}x{row['width']}"
        scene = f"{(INPUTS + TARGETS) * seconds:.2f}"
        return size, f"{1e3 * seconds:.1f}", f"{1 / seconds:.0f}", scene

    def disk_row(name: str, each: float) -> tuple:
        terabytes = each * SCENES * PHOTOGRAPHS / 1e12
        return name, f"{each / 1e3:.0f}", f"{terabytes:.2f}", f"{100 * terabytes:.0f}"

    def kernels_row(kernel: str) -> tuple:
        rows = {row["card"]: row for row in estimates if row["kernel"] == kernel}
        return kernel, *(f"{1e3 * row['seconds']:.2f} {row['bound']}" for row in rows.values())

    estimates = machine_code["estimates"]
    cards = list(dict.fromkeys(row["card"] for row in estimates))
    kernels = list(dict.fromkeys(row["kernel"] for row in estimates))
    sums = [sum(row["seconds"] for row in estimates if row["card"] == card) for card in cards]
    total = sum(flops[h, w] * batch * steps for h, w, batch, steps in STAGES.values())
    forms = {
        "JPEG for 540x960 (bytes a pixel as above)": jpeg_bytes,
        "JPEG 90 of 256x256": median(row["jpeg_bytes_256"] for row in files),
        "disparities of 272x484": scaling["disparity_bytes"],
    }
    rendered = [
        row
        for row in render["rows"]
        if row["backend"] == "cpu" and row["without"] is None and row["scene"] in RENDERED
    ]
    return {
        "views": markdown(
            "views | TFLOP | kept, GB in fp32 | million Gaussians | CPU, s | GFLOP/s",
            map(views_row, network),
        ),
        "parts": markdown(
            "part | of the seconds | 8 to 64 views, times",
            map(parts_row, parts),
        ),
        "render": markdown(
            "targets | million Gaussians | CPU, s, with gradients | of the network's step",
            map(render_row, rendered),
        ),
        "stages": markdown(
            "stage | PFLOP a step | EFLOP | GPU hours at the peak | million photographs read "
            "| times each",
            [
                *map(stages_row, STAGES),
                ("all", "", f"{total / 1e18:.1f}", f"{total / PEAK / 3600:,.0f}", "", ""),
            ],
        ),
        "gpus": markdown(
            "GPUs | scenes each | ms a step, at least | GB sent by each | GB/s "
            "| thousand photographs/s | cores for each GPU | GB/s of JPEG",
            map(gpus_row, GPUS),
        ),
        "kernels": markdown(
            " | ".join(["estimated, ms", *cards]),
            [*map(kernels_row, kernels), ("all", *(f"{1e3 * value:.1f}" for value in sums))],
        ),
        "photographs": markdown(
            "scene | files | kB each | bytes a pixel | 540x960 at that, kB "
            "| 256x256 as JPEG 90, kB",
            map(photographs_row, files, pixel_bytes),
        ),
        "reading": markdown(
            "view | ms of a core | photographs/s of a core | s of a core for a scene of 40",
            map(reading_row, scaling["reading"]),
        ),
        "disk": markdown(
            f" | kB a photograph | {SCENES:,} scenes, TB | 100 times, TB",
            (disk_row(*form) for form in forms.items()),
        ),
    }


def markdown(head: str, rows: Iterable[tuple]) -> str:
    """Write a table."""
    columns = head.count("|") + 1
    lines = [head, " | ".join(["---"] * columns), *(" | ".join(row) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines)


def filled(page: str) -> str:
    """Return the page with its tables made anew."""
    new = tables()

    def fill(match: re.Match) -> str:
        return f"<!-- {match[1]} -->\n{new[match[1]]}\n<!-- end -->"

    return re.sub(r"<!-- (\w+) -->\n.*?<!-- end -->", fill, page, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
