"""The operators on numbers of every size."""

from collections.abc import Callable, Iterator
from functools import partial

import torch

from asysplat import ops
from asysplat.benchmark.scenes import random_numbers
from asysplat.benchmark.stability.judge import ALL_PRECISIONS, Case, Comparison, Tensors, judge
from asysplat.benchmark.stability.views import PHOTOGRAPHS, make_photographs
from asysplat.benchmark.timing import Result
from asysplat.ops.adam import adam_step
from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference

AREA = "operators"
HUGE = 1e18  # its square is still a float32
KEPT = ("dt", "A", "D")  # inputs of a scan that are always fp32
LENGTH, STATE = 131, 5  # tokens: more than two chunks, and no whole number of them
TOKEN = {"ssd": (3, 4), "selective_scan": (6,)}  # heads and head_dim, or channels
# The size of dt and of -A: about alike; of every size; so large that a token forgets all.
SCANNED = [("0.1", "1"), ("1e-8", "1"), ("1e3", "1"), ("0.1", "1e-4"), ("0.1", "1e4")]
SCANNED += [("spread", "1"), ("spread", "spread")]
SPREAD = {"dt": (1e-8, 1e3), "-A": (1e-4, 1e4)}
ATTENDED = {"zero": 0.0, "noise": 1.0, "noise times 10": 10.0}
MAPS = (1, 3, 4, 6, 2, 8)  # [B, V, h, w, H, P]
SIDE = 24  # pixels of an image whose loss is computed
ADAM = AdamSettings(beta1=0.9, beta2=0.99, eps=1e-15)
ADAM_STEPS, ROWS = 20, 50


def cases() -> Iterator[Case]:
    """Yield the cases of all operators but the plane sweep, whose inputs are views."""
    for precision in ALL_PRECISIONS:
        huge = precision != "fp16"  # which does not hold such numbers
        for name in TOKEN:
            for dt, rates in SCANNED:
                title = f"{name}, dt {dt}, -A {rates}"
                yield _case(title, precision, _scan, name, dt, rates, None)
            for which in ("x", "B", "C") if huge else ():
                title = f"{name}, {which} of 1e18"
                yield _case(title, precision, _scan, name, "0.1", "1", which)
        for grid in (1, 2):
            for values in (*ATTENDED, "one value", *(("values of 1e18",) if huge else ())):
                name = f"grid_attention, grid {grid}, {values}"
                yield _case(name, precision, _attention, values, grid)
        for rendered in PHOTOGRAPHS:
            for target in ("black", "noise"):
                name = f"image_loss, {rendered} against {target}"
                yield _case(name, precision, _image_loss, rendered, target)
    for kind in ("0", "1e-18", "1", "1e18", "spread", "some not finite"):
        yield Case(AREA, f"adam, gradients {kind}", "fp32", partial(_adam, kind))


def _case(name: str, precision: str, measure: Callable[..., Result], *what: object) -> Case:
    return Case(AREA, name, precision, partial(measure, *what, ALL_PRECISIONS[precision]))


def _scan(name: str, dt: str, rates: str, huge: str | None, dtype: torch.dtype) -> Result:
    inputs = {
        tensor: value.to(torch.float32 if tensor in KEPT else dtype)
        for tensor, value in _scanned(name, dt, rates, huge).items()
    }
    scan = getattr(ops, name)
    return judge(
        Comparison(
            fast=lambda tensors: {"y": scan(**tensors)},
            exact=lambda tensors: {"y": scan(**tensors, backend="reference")},
            inputs=inputs,
            leaves=tuple(inputs),
        )
    )


def _scanned(name: str, dt: str, rates: str, huge: str | None) -> Tensors:
    """Draw the inputs of a scan in float64."""
    uniform, normal = random_numbers(0)

    def sizes(kind: str, what: str, *shape: int) -> torch.Tensor:
        if kind == "spread":
            low, high = SPREAD[what]
            return low * (high / low) ** uniform(*shape)
        return float(kind) * (0.5 + uniform(*shape))

    token = TOKEN[name]
    channels = (token[0],) if name == "ssd" else (*token, STATE)
    tensors = {
        "x": normal(2, LENGTH, *token),
        "dt": sizes(dt, "dt", 2, LENGTH, token[0]),
        "A": -sizes(rates, "-A", *channels),
        "B": normal(2, LENGTH, STATE),
        "C": normal(2, LENGTH, STATE),
        "D": normal(token[0]),
    }
    return tensors if huge is None else tensors | {huge: HUGE * tensors[huge]}


def _attention(values: str, grid: int, dtype: torch.dtype) -> Result:
    _, normal = random_numbers(0)
    inputs = {name: normal(*MAPS) for name in "qkv"}
    if values in ATTENDED:
        inputs = {name: ATTENDED[values] * tensor for name, tensor in inputs.items()}
    elif values == "one value":
        inputs = {name: torch.ones_like(tensor) for name, tensor in inputs.items()}
    else:
        inputs["v"] = HUGE * inputs["v"]
    score = inputs["q"].norm(dim=-1).max() * inputs["k"].norm(dim=-1).max() / MAPS[-1] ** 0.5
    return judge(
        Comparison(
            fast=lambda tensors: {"o": ops.grid_attention(**tensors, grid=grid)},
            exact=lambda tensors: {
                "o": ops.grid_attention(**tensors, grid=grid, backend="reference")
            },
            inputs={name: tensor.to(dtype) for name, tensor in inputs.items()},
            leaves=("q", "k", "v"),
            arithmetic=dtype,
            exponent=max(1.0, float(score)),
        )
    )


def _image_loss(rendered: str, target: str, dtype: torch.dtype) -> Result:
    # Both are noise, but not the same.
    images = make_photographs(rendered, 2, SIDE).flip(-1), make_photographs(target, 2, SIDE)
    return judge(
        Comparison(
            fast=lambda tensors: {"loss": ops.image_loss(**tensors)},
            exact=lambda tensors: {"loss": ops.image_loss(**tensors, backend="reference")},
            inputs={
                name: image.to(dtype)
                for name, image in zip(("rendered", "target"), images, strict=True)
            },
            leaves=("rendered",),
        )
    )


def _adam(kind: str) -> Result:
    uniform, normal = random_numbers(0)
    gradients = normal(ADAM_STEPS, ROWS, 3)
    if kind == "spread":
        gradients *= 10 ** (36 * uniform(ADAM_STEPS, ROWS, 1) - 18)
    elif kind == "some not finite":
        gradients[uniform(ADAM_STEPS, ROWS, 3) < 0.02] = torch.nan
        gradients[uniform(ADAM_STEPS, ROWS, 3) < 0.02] = -torch.inf
    else:
        gradients *= float(kind)
    inputs = {"parameter": normal(ROWS, 3), "gradients": gradients, "rates": uniform(3)}
    inputs = {name: tensor.float() for name, tensor in inputs.items()}
    exact = partial(_steps, adam_step_reference)
    return judge(Comparison(partial(_steps, adam_step), exact, inputs))


def _steps(step: Callable[..., int], tensors: Tensors) -> Tensors:
    """Take the steps of Adam; return where they end."""
    parameter = tensors["parameter"].clone()
    mean, square = torch.zeros_like(parameter), torch.zeros_like(parameter)
    counts = torch.zeros(ROWS, dtype=torch.int32)
    seen = torch.ones(ROWS, dtype=torch.bool)
    for gradient in tensors["gradients"]:
        rows = Rows(parameter, gradient.contiguous(), mean, square, counts, tensors["rates"])
        step([rows], seen, ADAM)
    return {"parameter": parameter}
