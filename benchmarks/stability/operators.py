"""The operators on numbers of every size."""

from collections.abc import Callable, Iterator
from functools import partial

import torch

from asysplat import ops
from asysplat.ops.adam import adam_step
from asysplat.ops.adam.reference import AdamSettings, Rows, adam_step_reference
from benchmarks.scenes import random_numbers
from benchmarks.stability.comparison import (
    ALL_PRECISIONS,
    StabilityCase,
    Tensors,
    compare_to_reference,
)
from benchmarks.stability.hostile import IMAGES, make_images
from benchmarks.timing import Result

HUGE = 1e18  # its square is still finite in float32
ALWAYS_FP32 = ("dt", "A", "D")  # inputs of a scan
LENGTH, STATE = 131, 5  # the number of tokens is more than two chunks, but not a multiple of one
TOKEN = {"ssd": (3, 4), "selective_scan": (6,)}  # shape: heads and head_dim, or channels
# Sizes of dt and of -A, as numbers or as "spread" over the range in SPREAD
SCAN_SIZES = [("0.1", "1"), ("1e-8", "1"), ("1e3", "1"), ("0.1", "1e-4"), ("0.1", "1e4")]
SCAN_SIZES += [("spread", "1"), ("spread", "spread")]
SPREAD = {"dt": (1e-8, 1e3), "-A": (1e-4, 1e4)}
ATTENTION_FACTORS = {"zero": 0.0, "noise": 1.0, "noise times 10": 10.0}
MAPS = (1, 3, 4, 6, 2, 8)  # shape [B, V, h, w, H, P] of q, k and v
SIDE = 24  # pixels of an image for the loss
ADAM = AdamSettings(beta1=0.9, beta2=0.99, eps=1e-15)
ADAM_STEPS, ROWS = 20, 50


def operator_cases() -> Iterator[StabilityCase]:
    """Yield the cases of all operators except the plane sweep, whose inputs are views."""

    def case(name: str, precision: str, measure: Callable[..., Result], *args: object):
        run = partial(measure, *args, ALL_PRECISIONS[precision])
        return StabilityCase(name, precision, run)

    for precision in ALL_PRECISIONS:
        huge = precision != "fp16"  # fp16 cannot represent such numbers
        for name in TOKEN:
            for dt, rates in SCAN_SIZES:
                yield case(f"{name}, dt {dt}, -A {rates}", precision, _scan, name, dt, rates, None)
            for which in ("x", "B", "C") if huge else ():
                yield case(f"{name}, {which} of 1e18", precision, _scan, name, "0.1", "1", which)
        for grid in (1, 2):
            for values in (*ATTENTION_FACTORS, "one value", *(("values of 1e18",) if huge else ())):
                name = f"grid_attention, grid {grid}, {values}"
                yield case(name, precision, _attention, values, grid)
        for rendered in IMAGES:
            for target in ("black", "noise"):
                name = f"image_loss, {rendered} against {target}"
                yield case(name, precision, _image_loss, rendered, target)
    for kind in ("0", "1e-18", "1", "1e18", "spread", "some not finite"):
        run = partial(_adam, kind)
        yield StabilityCase(f"adam, gradients {kind}", "fp32", run)


def _compare(
    operator: Callable, output: str, inputs: Tensors, leaves: tuple[str, ...], **options
) -> Result:
    fast, exact = (
        lambda tensors, backend=backend: {output: operator(**tensors, backend=backend)}
        for backend in ("auto", "reference")
    )
    return compare_to_reference(fast, exact, inputs, leaves, **options)


def _scan(name: str, dt: str, rates: str, huge: str | None, dtype: torch.dtype) -> Result:
    uniform, normal = random_numbers(0)

    def sizes(kind: str, what: str, *shape: int) -> torch.Tensor:
        if kind == "spread":
            low, high = SPREAD[what]
            return low * (high / low) ** uniform(*shape)
        return float(kind) * (0.5 + uniform(*shape))

    token = TOKEN[name]
    channels = (token[0],) if name == "ssd" else (*token, STATE)
    inputs = {
        "x": normal(2, LENGTH, *token),
        "dt": sizes(dt, "dt", 2, LENGTH, token[0]),
        "A": -sizes(rates, "-A", *channels),
        "B": normal(2, LENGTH, STATE),
        "C": normal(2, LENGTH, STATE),
        "D": normal(token[0]),
    }
    if huge is not None:
        inputs[huge] = HUGE * inputs[huge]
    inputs = {n: t.to(torch.float32 if n in ALWAYS_FP32 else dtype) for n, t in inputs.items()}
    return _compare(getattr(ops, name), "y", inputs, tuple(inputs))


def _attention(values: str, grid: int, dtype: torch.dtype) -> Result:
    _, normal = random_numbers(0)
    inputs = {name: normal(*MAPS) for name in "qkv"}
    if values in ATTENTION_FACTORS:
        inputs = {name: ATTENTION_FACTORS[values] * tensor for name, tensor in inputs.items()}
    elif values == "one value":
        inputs = {name: torch.ones_like(tensor) for name, tensor in inputs.items()}
    else:
        inputs["v"] = HUGE * inputs["v"]
    score = inputs["q"].norm(dim=-1).max() * inputs["k"].norm(dim=-1).max() / MAPS[-1] ** 0.5
    inputs = {name: tensor.to(dtype) for name, tensor in inputs.items()}
    operator, exponent = partial(ops.grid_attention, grid=grid), max(1.0, float(score))
    return _compare(operator, "o", inputs, tuple("qkv"), arithmetic=dtype, exponent=exponent)


def _image_loss(rendered: str, target: str, dtype: torch.dtype) -> Result:
    # Flipped, so that noise differs from noise.
    inputs = {
        "rendered": make_images(rendered, 2, SIDE).flip(-1).to(dtype),
        "target": make_images(target, 2, SIDE).to(dtype),
    }
    return _compare(ops.image_loss, "loss", inputs, ("rendered",))


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

    def take_steps(step: Callable[..., int], tensors: Tensors) -> Tensors:
        parameter = tensors["parameter"].clone()
        mean, square = torch.zeros_like(parameter), torch.zeros_like(parameter)
        counts = torch.zeros(ROWS, dtype=torch.int32)
        for gradient in tensors["gradients"]:
            rows = Rows(parameter, gradient.contiguous(), mean, square, counts, tensors["rates"])
            step([rows], torch.ones(ROWS, dtype=torch.bool), ADAM)
        return {"parameter": parameter}

    fast, exact = partial(take_steps, adam_step), partial(take_steps, adam_step_reference)
    return compare_to_reference(fast, exact, inputs)
