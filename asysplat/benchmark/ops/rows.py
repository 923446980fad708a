"""What stands in the table of one operator: its paths, the sequential loop, its bare products."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from asysplat.benchmark.ops.cases import Case
from asysplat.benchmark.ops.run import Path
from asysplat.benchmark.products import Product, products, with_gradients
from asysplat.benchmark.timing import rise_gb
from asysplat.errors import InputError
from asysplat.evaluation.cost import GB

LOOP, MATMULS = "loop", "matmuls"


@dataclass
class Row:
    """
    Args:
        case: that the row is about.
        path: name of the backend, LOOP or MATMULS.
        precision: of the inputs.
        runs: what is timed, by pass.
        counts: for MATMULS, the products that are timed instead, by pass.
        scale: from the time of a run to that of the whole case.
        found: the row's other results.
    """

    case: Case
    path: str
    precision: str
    runs: Mapping[str, Callable[[], object]] = field(default_factory=dict)
    counts: Mapping[str, Mapping[Product, int]] = field(default_factory=dict)
    scale: float = 1.0
    found: dict[str, Any] = field(default_factory=lambda: {"error": None, "bytes_per_token": None})


def make_rows(
    case: Case,
    small: Case,
    precisions: Mapping[str, torch.dtype],
    loop_tokens: int,
    device: torch.device,
) -> list[Row]:
    """
    Args:
        case: what is timed.
        small: one of its kind that errors are measured on.
        precisions: types of the inputs, by name.
        loop_tokens: length of the sequence that the loop is timed on.
    """
    rows = []
    for precision, dtype in precisions.items():
        rows += _paths(case, small, precision, dtype, device)
        rows += _matmuls(case, precision, dtype, device)
    return rows + _loop(case, small, loop_tokens, device)


def _paths(
    case: Case, small: Case, precision: str, dtype: torch.dtype, device: torch.device
) -> list[Row]:
    """Those that are there."""
    exact = Path(small, "reference", dtype, device).truth()
    rows = []
    for backend in case.paths:
        if backend in {"cpu", "cuda"} - {device.type}:
            continue
        try:
            errors = Path(small, backend, dtype, device).errors(exact)
        except InputError:  # the operator has no such path, or it cannot run here
            continue
        path = Path(case, backend, dtype, device)
        found = {"error": _on(small, errors), "bytes_per_token": _memory(path)}
        rows.append(Row(case, backend, precision, path.passes(), found=found))
    return rows


def _loop(case: Case, small: Case, tokens: int, device: torch.device) -> list[Row]:
    """The reference in fp32, where it is one token after the other."""
    shorter = case.shortened(tokens)
    if shorter is None:
        return []
    reference = Path(small, "reference", torch.float32, device)
    path = Path(shorter, "reference", torch.float32, device)
    found = {
        "error": _on(small, reference.errors(reference.truth())),
        "bytes_per_token": _memory(path),
        "loop_tokens": shorter.length,
    }
    scale = case.tokens / shorter.tokens
    return [Row(case, LOOP, "fp32", path.passes(), scale=scale, found=found)]


def _matmuls(case: Case, precision: str, dtype: torch.dtype, device: torch.device) -> list[Row]:
    """The case's products, where it has any."""
    sizes = case.sizes()
    if not sizes:
        return []
    counts = {
        "forward": products(sizes, dtype, device),
        "forward_backward": products(with_gradients(sizes), dtype, device),
    }
    return [Row(case, MATMULS, precision, counts=counts)]


def _on(small: Case, errors: dict[str, Any]) -> dict[str, Any]:
    return {"measured_on": asdict(small), **errors}


def _memory(path: Path) -> dict[str, float]:
    """Peak bytes a token, of each pass."""
    return {
        name: GB * rise_gb(run, path.device) / path.case.tokens
        for name, run in path.passes().items()
    }
