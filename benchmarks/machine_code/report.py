"""Registers, memory and instructions of every GPU kernel, for GPUs that are not at hand."""

import math
from collections import Counter
from importlib.util import find_spec

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from asysplat.errors import InputError
from benchmarks.compare import Kind, TrackedMetrics
from benchmarks.scenes import SCENES
from benchmarks.table import machine_text, make_table, number_column, text_column
from benchmarks.timing import Result

TRACKED = TrackedMetrics(
    names=("capability", "kernel", "case"),
    must_match=(),
    kinds={"instructions": Kind("instructions", "slower", "faster", math.log(1.1))},
)
SCENE = "4M"  # of benchmarks.scenes, whose rendering is estimated
NOTES = """\
registers and stack of a thread, in memory where registers did not suffice; shared memory of a \
block; occupancy: warps that fit on a multiprocessor, of its limit"""
ESTIMATE_NOTES = """\
{gaussians:,} Gaussians without SH, {height}x{width}, {pairs:,} pairs of splat and tile, one view, \
forward and backward, as in training; without torch's sorts, launches and waiting
bound: the resource that takes longest: issuing instructions, float64 or special functions, bytes"""


def measure(options: DictConfig, console: Console) -> Result:
    """Compile every kernel for `options.machine_code.capabilities`.

    Returns:
        "rows": for each capability and kernel, what a thread and a block take, and instructions;
        "estimates": for each card of these capabilities, the seconds of the renderer's kernels.
    """
    if not find_spec("triton"):
        raise InputError("suite=machine_code needs Triton, which comes with torch on Linux.")
    from benchmarks.machine_code.cubin import LIMITS, compile_launch, measure_usage, without_repeats
    from benchmarks.machine_code.estimate import CARDS, estimate_launches, measure_work
    from benchmarks.machine_code.launches import TRAINING, record_launches

    capabilities = list(options.machine_code.capabilities)
    if not capabilities or not {*capabilities} <= {*LIMITS}:
        raise InputError(
            f"machine_code.capabilities={capabilities}: choose from {', '.join(map(str, LIMITS))}."
        )
    rows, training = [], {}
    for capability in capabilities:
        launches = without_repeats(record_launches(capability), capability)
        for launch in track(launches, f"capability {capability}", console=console):
            usage = measure_usage(compile_launch(launch, capability), capability)
            total = sum(usage.instructions, Counter())
            row = {"capability": capability, "kernel": launch.name, "case": launch.case}
            row |= usage._asdict() | {"instructions": total.total(), "float64": total["float64"]}
            rows.append(row)
            if launch.case == TRAINING:
                training.setdefault((capability, launch.kernel_name), []).append(usage)
    scene = SCENES[SCENE]()
    work, estimates = measure_work(scene), []
    for name, card in CARDS.items():
        for kernel in work.programs if card.capability in capabilities else ():
            usages = training[card.capability, kernel]
            seconds, bound = estimate_launches(card, kernel, usages, work)
            estimates.append({"card": name, "kernel": kernel, "seconds": seconds, "bound": bound})
    sizes = {"gaussians": scene[0].num_gaussians}
    sizes |= {"height": scene[1].height, "width": scene[1].width, "pairs": work.pairs}
    return {"rows": rows, "estimates": estimates, "scene": sizes}


def tables(results: Result) -> list[Table]:
    """Show what every kernel takes, and the estimates."""
    usage = {
        "capability": text_column("{capability}"),
        "kernel": text_column("{kernel}"),
        "case": text_column("{case}"),
        "registers": text_column("{registers}"),
        "stack (B)": text_column("{stack}"),
        "shared (kB)": number_column("shared", "{:.1f}", 1e3),
        "warps": text_column("{warps}"),
        "occupancy": number_column("occupancy", "{:.2f}"),
        "instructions": text_column("{instructions}"),
        "of float64": text_column("{float64}"),
    }
    estimates = {
        "card": text_column("{card}"),
        "kernel": text_column("{kernel}"),
        "estimated (ms)": number_column("seconds", "{:.2f}", 1e-3),
        "bound": text_column("{bound}"),
    }
    notes = ESTIMATE_NOTES.format(**results["scene"])
    return [
        make_table("Kernels", usage, results["rows"], f"{machine_text(results)}\n{NOTES}", names=3),
        make_table("Renderer, estimated", estimates, results["estimates"], notes, names=2),
    ]
