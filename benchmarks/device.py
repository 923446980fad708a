"""Error and speed of all kernels on the machine at hand, to be pasted into a report.

An operator that fails is a row with the reason, and the others are measured.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from asysplat import ops, render
from asysplat.doctor import processor
from asysplat.kernels.dispatch import load_kernels
from asysplat.kernels.self_check import (
    TOLERANCE,
    Check,
    describe_errors,
    describe_failure,
    describe_gpu,
    seeded_normal,
)
from asysplat.ops import self_check
from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference
from asysplat.rendering.self_check import render as check_render
from asysplat.runs.machine import find_device
from benchmarks import libraries
from benchmarks.compare import ERROR, TIME, TrackedMetrics
from benchmarks.libraries import LIBRARIES
from benchmarks.ops import (
    ATTENTION,
    BACKENDS,
    CONVOLUTION,
    PLANE_SWEEP,
    REFERENCE,
    SCANS,
    SHAPES,
    Sizes,
    make_path,
)
from benchmarks.options import PRECISIONS
from benchmarks.render import Backend, prepare_inputs, run_passes
from benchmarks.scenes import random_scene
from benchmarks.table import (
    NOT_MEASURED,
    Columns,
    machine_text,
    make_table,
    number_column,
    text_column,
)
from benchmarks.timing import Measurement, Result, measure_run, relative_l2, time_in_rounds

TRACKED = TrackedMetrics(
    names=("operator", "backend"),
    must_match=("sizes", "precision"),
    kinds={"kernels": TIME, "error": ERROR},
)
SECONDS = 3.0  # no round of an operator begins after so many seconds
AGREEMENT = 0.05  # greatest relative difference of outputs that are timed: bf16, other cut-offs
NUMBERS = (3, 4, 3, 1, 12)  # numbers of a Gaussian with SH of degree 1
SIZES: dict[str, dict[str, Sizes]] = {  # of the operators that each type of device has kernels for
    "cuda": {
        "render": {"gaussians": 100_000, "height": 540, "width": 960},
        "render_1M": {"gaussians": 1_000_000, "height": 1080, "width": 1920},
        "ssd": {"batch": 1, "length": 8192, "heads": 28, "head_dim": 64, "state": 256},
        "selective_scan": {"batch": 32, "length": 1024, "channels": 128, "state": 16},
        "conv_silu": {"batch": 1, "length": 8192, "channels": 2304, "size": 4, "before": 3},
        "plane_sweep": {"batch": 1, "views": 16, "height": 128, "width": 128}
        | {"planes": 48, "neighbors": 4},
        "grid_attention": {"batch": 1, "views": 16, "height": 16, "width": 16}
        | {"heads": 14, "head_dim": 64, "grid": 2},
        "adam": {"gaussians": 100_000},
        "image_loss": {"images": 1, "height": 540, "width": 960},
    },
    "cpu": {
        "render": {"gaussians": 10_000, "height": 128, "width": 128},
        "ssd": {"batch": 1, "length": 1024, "heads": 4, "head_dim": 64, "state": 64},
        "selective_scan": {"batch": 4, "length": 256, "channels": 64, "state": 16},
        "conv_silu": {"batch": 1, "length": 1024, "channels": 320, "size": 4, "before": 3},
        "plane_sweep": {"batch": 1, "views": 4, "height": 64, "width": 64}
        | {"planes": 48, "neighbors": 3},
        "grid_attention": {"batch": 1, "views": 4, "height": 16, "width": 16}
        | {"heads": 4, "head_dim": 64, "grid": 2},
        "adam": {"gaussians": 10_000},
        "image_loss": {"images": 4, "height": 128, "width": 128},
    },
}
NOTES = f"""\
error: relative L2 error against the reference in float64, of a small case in fp32; WRONG: over \
{TOLERANCE:g}
first: the first call, which compiles where no cache has the kernels; then medians; ratio: torch / \
kernels
library: {", ".join(LIBRARIES)}; with inputs in its own layout, where its output is ours up to \
{AGREEMENT:.0%}"""


class Case(NamedTuple):
    """An operator with inputs on a device.

    Args:
        check: compares a backend with the reference on a small case.
        run: runs a backend, both passes where there are two, and returns the output.
        kernels: name of the backend with kernels.
        torch: name of the backend in torch; None where it would take minutes.
        library: name of a library with the operator, and a function that prepares its run.
    """

    check: Check
    run: Callable[[str], Tensor]
    kernels: str
    torch: str | None
    library: tuple[str, Callable[[], libraries.Run]] | None = None


def choose_precision(operator: str, device: torch.device) -> str:
    """Return the precision of the inputs that an operator is timed on: bf16 where GPUs train so."""
    if operator not in SHAPES or device.type != "cuda":
        return "fp32"
    return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "fp32"


def _render_case(
    sizes: Sizes, device: torch.device, backward: bool = True, torch_too: bool = True
) -> Case:
    inputs = prepare_inputs(random_scene(*sizes.values()), device)
    gaussians, cameras, weights = inputs

    def run(backend: str) -> Tensor:
        if backward:
            return run_passes(Backend(backend, device), inputs).image
        with torch.no_grad():
            return render(gaussians, cameras, backend=backend, depth=False).image

    def check(device: torch.device, backend: str) -> dict[str, float]:
        errors = check_render(device, backend)
        return errors if backward else {"outputs": errors["outputs"]}

    last = weights if backward else None
    prepare = partial(libraries.render_by_gsplat, gaussians, cameras, last)
    return Case(check, run, device.type, REFERENCE if torch_too else None, ("gsplat", prepare))


def _operator_case(sizes: Sizes, device: torch.device, operator: str) -> Case:
    dtype = PRECISIONS[choose_precision(operator, device)]
    path = make_path(operator, sizes, REFERENCE, dtype, device)
    functions = {
        "ssd": ("mamba_ssm", libraries.ssd_by_mamba),
        "selective_scan": ("mamba_ssm", libraries.selective_scan_by_mamba),
        ATTENTION: (
            "flash_attn",
            partial(libraries.grid_attention_by_flash, grid=sizes.get("grid")),
        ),
    }
    name, prepare = functions.get(operator, (None, None))
    attention = operator == ATTENTION  # torch has its kernels
    return Case(
        check=getattr(self_check, operator),
        run=lambda backend: replace(path, backend=backend).forward_backward()[0],
        kernels=BACKENDS[ATTENTION] if attention else device.type,
        torch=REFERENCE if attention else BACKENDS[operator],
        library=None if prepare is None else (name, partial(prepare, path.inputs, path.weights)),
    )


def _adam_case(sizes: Sizes, device: torch.device) -> Case:
    draw, num = seeded_normal(device, torch.float32), sizes["gaussians"]
    visible, settings = draw(num) > 0, AdamSettings(0.9, 0.999, 1e-15)
    rows = []
    for numbers in NUMBERS:
        # Parameters, gradients and both averages; a mean square is not negative
        tensors = [draw(num, numbers).abs() for _ in range(4)]
        steps = torch.zeros(num, dtype=torch.int32, device=device)
        rows.append(Rows(*tensors, steps, torch.full((numbers,), 1e-3, device=device)))

    def run(backend: str) -> Tensor:
        if backend == REFERENCE:
            step = adam_step_reference
        else:
            step = getattr(load_kernels("adam", backend), f"adam_step_{backend}")
        step(rows, visible, settings)
        return rows[0].parameter

    return Case(self_check.adam, run, device.type, REFERENCE)


def _image_loss_case(sizes: Sizes, device: torch.device) -> Case:
    draw, shape = seeded_normal(device, torch.float32), (sizes["images"], 3, *[*sizes.values()][1:])
    rendered, target = draw(*shape).sigmoid().requires_grad_(), draw(*shape).sigmoid()

    def run(backend: str) -> Tensor:
        losses = ops.image_loss(rendered, target, backend=backend)
        torch.autograd.grad(losses.sum(), rendered)
        return losses.detach()

    return Case(self_check.image_loss, run, device.type, REFERENCE)


CASES: dict[str, Callable[[Sizes, torch.device], Case]] = {
    "render": _render_case,
    "render forward": partial(_render_case, backward=False),
    "render_1M": partial(_render_case, torch_too=False),
    **{
        operator: partial(_operator_case, operator=operator)
        for operator in (*SCANS, CONVOLUTION, PLANE_SWEEP, ATTENTION)
    },
    "adam": _adam_case,
    "image_loss": _image_loss_case,
}


def measure(options: DictConfig, console: Console) -> Result:
    """Check and time the kernels of every operator on `options.device`.

    Returns:
        "device": the processor or the GPU, its driver and compiler; "libraries": names and
        versions; "rows": see `measure_operator`.
    """
    device = find_device(options.device)
    found = describe_gpu(device) if device.type == "cuda" else processor()
    operators = [name for name in CASES if name.partition(" ")[0] in SIZES[device.type]]
    rows = []
    for operator in track(operators, "operators", console=console):
        rows.append(measure_operator(operator, device, options.repeats))
        # On a GPU it takes minutes, and what was measured before an interruption is not lost.
        console.print(_line(rows[-1]), markup=False, highlight=False, soft_wrap=True)
    names = ", ".join(map(libraries.describe_library, LIBRARIES))
    return {"device": found, "libraries": names, "rows": rows}


def measure_operator(operator: str, device: torch.device, repeats: int) -> Result:
    """Check and time an operator's kernels, beside torch and a library.

    Returns:
        A row with "error", of outputs and gradients; "first", the seconds of the first call;
        "kernels", "torch" and "library", times in seconds; "fault", what is wrong with the kernels,
        or ""; "notes", why others have no time. What was not measured is None.
    """
    sizes = SIZES[device.type][operator.partition(" ")[0]]
    row = {"operator": operator, "backend": device.type, "sizes": dict(sizes)}
    row |= {"precision": choose_precision(operator, device), "fault": "", "notes": []}
    row |= dict.fromkeys(("error", "first", "kernels", "torch", "library"))
    try:
        case = CASES[operator](sizes, device)
        kernels = partial(case.run, case.kernels)
        row["first"] = measure_run(kernels, device)
        errors = case.check(device, case.kernels)
        row["fault"] = describe_errors(errors)
        # JSON has no NaN; the fault names it.
        row["error"] = {name: error for name, error in errors.items() if error < torch.inf}
        runs = {"kernels": kernels} | _find_others(case, kernels(), row)
        measurement = Measurement(
            lambda: {name: measure_run(run, device) for name, run in runs.items()}
        )
        time_in_rounds([measurement], repeats, seconds=SECONDS)
        row |= {name: measurement.summarize(name) for name in runs}
    except Exception as failure:  # compilers and drivers raise many kinds
        row["fault"] = f"do not run ({describe_failure(failure)})"
    return row


def _find_others(case: Case, output: Tensor, row: Result) -> dict[str, libraries.Run]:
    """Run torch and the library once, and return those that run and agree with the kernels.

    The row gets a note of a library that does not, and a fault where torch does not agree.
    """
    runs: dict[str, libraries.Run] = {}
    others: dict[str, tuple[str, Callable[[], libraries.Run]]] = {}
    if case.torch is not None:
        others["torch"] = ("torch", lambda: partial(case.run, case.torch))
    if case.library and libraries.has_library(case.library[0]):
        others["library"] = case.library
    for kind, (name, prepare) in others.items():
        try:
            run = prepare()
            difference = relative_l2(output, run().cpu().double())
        except Exception as failure:  # such as a library for another version of torch
            row["notes"].append(f"{name} does not run ({describe_failure(failure)})")
            continue
        if difference <= AGREEMENT:
            runs[kind] = run
        elif kind == "torch":
            row["fault"] = row["fault"] or f"differ from torch by {difference:.0%} where timed"
        else:
            row["notes"].append(f"{name}'s output differs by {difference:.0%}")
    return runs


def _line(row: Result) -> str:
    if row["kernels"] is None:
        return f"{row['operator']}: {row['fault']}"
    times = {name: row[name] for name in ("kernels", "torch", "library") if row[name]}
    words = [f"{name} {1e3 * time['median']:.2f} ms" for name, time in times.items()]
    return f"{row['operator']}: {', '.join(filter(None, [*words, row['fault']]))}"


def _error_cell(row: Result) -> str:
    return "WRONG" if row["fault"] else " / ".join(f"{e:.0e}" for e in row["error"].values())


def _ratio_cell(row: Result) -> str:
    if row["torch"] is None:
        return NOT_MEASURED
    return f"{row['torch']['median'] / row['kernels']['median']:.1f}"


COLUMNS: Columns = {  # at most 80 characters: a narrow terminal would cut cells off
    "operator": text_column("{operator}"),
    "output error\n/ gradients": _error_cell,
    "first\ns": number_column("first", "{:.1f}"),
    "kernels\nms": number_column("kernels.median", "{:.2f}", 1e-3),
    "torch\nms": number_column("torch.median", "{:.2f}", 1e-3),
    "ratio": _ratio_cell,
    "library\nms": number_column("library.median", "{:.2f}", 1e-3),
}


def tables(results: Result) -> list[Table]:
    """Show every operator; below, what is wrong, and the inputs that are timed."""
    notes = [f"{machine_text(results)}, revision {results.get('revision')}", NOTES]
    for row in results["rows"]:
        sizes = ", ".join(f"{name} {size}" for name, size in row["sizes"].items())
        notes.append(f"{row['operator']}: {row['precision']}, {sizes}")
    notes += _faults(results)
    notes += [f"{row['operator']}: {note}" for row in results["rows"] for note in row["notes"]]
    title = f"Kernels on {results['device']}; {results['libraries']}"
    return [make_table(title, COLUMNS, results["rows"], "\n".join(notes))]


def verdict(results: Result) -> str | None:
    """Return a message that names the kernels that are wrong; None if there are none."""
    faults = _faults(results)
    return f"wrong: {'; '.join(faults)}" if faults else None


def _faults(results: Result) -> list[str]:
    return [
        f"{row['operator']}'s kernels {row['fault']}" for row in results["rows"] if row["fault"]
    ]
