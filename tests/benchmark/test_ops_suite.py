"""The suite on operators of a moment, and the products that they are compared with."""

import math

import pytest
import torch

from asysplat.benchmark.ops import (
    PASSES,
    SCANS,
    SLANT,
    OpCase,
    PlaneSweepCase,
    make_path,
    make_rows,
)
from asysplat.benchmark.options import CPU, PRECISIONS, check_names, find_device
from asysplat.benchmark.products import (
    MAX_NUMBERS,
    Operand,
    RecordProducts,
    products,
    time_products,
    with_gradients,
)
from asysplat.benchmark.scenes import DISTANCE
from asysplat.errors import InputError
from asysplat.evaluation.static_cost import true_flops
from asysplat.scene import Cameras

pytestmark = pytest.mark.medium

BOUNDS = {"fp32": 2e-6, "bf16": 1e-2}
PLANE_SWEEP_BOUND = 1e-5  # a pixel whose best two planes cost the same to the last bit may turn
LENGTH, LOOP_TOKENS = 150, 50
TINY = {
    "ssd": {"batch": 1, "length": LENGTH, "heads": 8, "head_dim": 16, "state": 8},
    "selective_scan": {"batch": 2, "length": LENGTH, "channels": 16, "state": 4},
    "grid_attention": {"batch": 1, "views": 2, "height": 4, "width": 6, "heads": 2, "head_dim": 8}
    | {"grids": [1, 2]},
    "plane_sweep": {"batch": 1, "views": 4, "height": 24, "width": 32, "stride": 2}
    | {"planes": 20, "neighbors": 2},
    "loop_tokens": LOOP_TOKENS,
    "exact": {
        "ssd": {"length": 140},  # all heads: few numbers would make an error of A's gradient chance
        "selective_scan": {"batch": 1},
        "grid_attention": {"views": 1},
        "plane_sweep": {"views": 3},
    },
}
ATTENTION = ("grid_attention/1", "grid_attention/2")


@pytest.fixture(scope="module")
def rows(run_suite):
    """The rows by operator, precision and path."""
    results = run_suite("ops", {"ops": TINY})
    return {(row["operator"], row["precision"], row["path"]): row for row in results["rows"]}


def test_every_operator_has_all_paths(rows):
    for operator in (*SCANS, *ATTENTION):
        for precision in BOUNDS:
            paths = {path for name, p, path in rows if (name, p) == (operator, precision)}
            assert paths - {"loop", "matmuls"}
            assert ("matmuls" in paths) == (operator != "selective_scan")
            assert ("loop" in paths) == (operator in SCANS and precision == "fp32")
    paths = {(precision, path) for name, precision, path in rows if name == "plane_sweep"}
    assert paths == {("fp32", path) for path in ("reference", "cpu")}


def test_errors_are_below_their_bounds(rows):
    for (operator, precision, path), row in rows.items():
        if path == "matmuls":
            assert row["error"] is None
            continue
        error = row["error"]
        assert error["measured_on"] != row["sizes"]
        if operator == "plane_sweep":
            assert error["gradients"] is None
            assert 0 < error["forward"] < PLANE_SWEEP_BOUND, path
            continue
        names = {"q", "k", "v"} if operator in ATTENTION else {"x", "dt", "A", "B", "C", "D"}
        assert error["gradients"].keys() == names
        worst = max(error["forward"], *error["gradients"].values())
        assert 0 < worst < BOUNDS[precision], (operator, precision, path)


def test_ratios_are_those_of_the_times(rows):
    for (operator, precision, _), row in rows.items():
        loop = rows.get((operator, "fp32", "loop")) or rows.get((operator, "fp32", "reference"))
        matmuls = rows.get((operator, precision, "matmuls"))
        for name in PASSES:
            if row[name] is None:
                assert (operator, name) == ("plane_sweep", "forward_backward")
                continue
            seconds = row[name]["median"]
            assert seconds > 0 and math.isfinite(row[name]["iqr"])
            if loop:
                expected = loop[name]["median"] / seconds
                assert row["faster_than_loop"][name] == pytest.approx(expected)
            if matmuls:
                expected = seconds / matmuls[name]["median"]
                assert row["over_matmuls"][name] == pytest.approx(expected)
        assert bool(loop) == bool(row["faster_than_loop"])
        assert bool(matmuls) == bool(row["over_matmuls"])
        if row["path"] == "loop":
            assert row["loop_tokens"] == LOOP_TOKENS


def test_errors_are_relative():
    case = OpCase("selective_scan", {"batch": 1, "length": 5, "channels": 3, "state": 2})
    path = make_path(case, "reference", torch.float32, CPU)
    output, gradients = path.exact()
    wrong = 2 * output, {name: 4 * grad for name, grad in gradients.items()}
    errors = path.errors(wrong)
    assert errors["forward"] == pytest.approx(1 / 2, abs=1e-5)
    assert errors["gradients"] == pytest.approx(
        dict.fromkeys(["x", "dt", "A", "B", "C", "D"], 3 / 4), abs=1e-5
    )


def flops_of(counts):
    return sum(count * true_flops(product.prepare("meta")) for product, count in counts.items())


MAPS = {"batch": 1, "views": 3, "height": 4, "width": 8, "heads": 2, "head_dim": 16, "grid": 2}
SEQUENCE = {"batch": 2, "length": 256, "heads": 4, "head_dim": 16, "state": 32}
CASES = [(OpCase("ssd", SEQUENCE), "chunked"), (OpCase("grid_attention", MAPS), "sdpa")]


@pytest.mark.parametrize("case, path", CASES, ids=lambda value: getattr(value, "name", None))
def test_products_are_those_of_the_operator(case, path):
    def forward():
        case.run({name: tensor.to("meta") for name, tensor in case.tensors().items()}, path)

    counts = products(case.products(), torch.float32, CPU)
    # The rest is the recurrence between the chunks.
    assert flops_of(counts) == pytest.approx(true_flops(forward), rel=0.01)
    both = products(with_gradients(case.products()), torch.float32, CPU)
    assert flops_of(both) == 3 * flops_of(counts)
    assert counts <= both


def test_large_products_are_split():
    batch, m, k, n = 6, 1000, 64, 30_000
    counts = products([(batch, m, k, n)], torch.bfloat16, CPU)
    assert flops_of(counts) == 2 * batch * m * k * n
    for product in counts:
        a, b = (operand.shape for operand in product.arguments)
        assert max(math.prod(a), math.prod(b), a[-2] * b[-1]) <= MAX_NUMBERS["cpu"]


def test_calls_are_recorded_under_their_label():
    a, weight = torch.randn(2, 5, 8), torch.randn(6, 8)
    maps, kernel = torch.randn(1, 4, 7, 7), torch.randn(6, 2, 3, 3)
    bias = torch.randn(6)

    def forward():
        torch.nn.functional.linear(a, weight)
        torch.nn.functional.linear(a, weight, bias)
        torch.nn.functional.conv2d(maps, kernel, bias, stride=2, padding=1, groups=2)
        torch.nn.functional.scaled_dot_product_attention(a, a, a)

    labels = ["first"]
    with torch.no_grad(), RecordProducts(lambda: labels[-1]) as recorder:
        forward()
        labels.append("second")
        a @ a.mT
    assert flops_of(recorder.counts["first"]) == true_flops(forward)
    (product,) = recorder.counts["second"]
    assert [operand.shape for operand in product.arguments] == [(2, 5, 8), (2, 8, 5)]
    assert product.arguments[0] == Operand((2, 5, 8), torch.float32)
    assert time_products(recorder.counts, CPU)["second"] > 0


def test_unknown_options_are_named():
    with pytest.raises(InputError, match=r"^ops\.precisions=fp8 is unknown: .*fp32, bf16"):
        check_names("ops.precisions", ["fp32", "fp8"], PRECISIONS)
    with pytest.raises(InputError, match=r"^ops\.precisions=None is unknown"):
        check_names("ops.precisions", [], PRECISIONS)
    with pytest.raises(InputError, match=r"^device=tpu is unknown: .*auto, cpu, cuda"):
        find_device("tpu")
    assert find_device("cpu") == CPU


def test_a_wrong_size_is_an_error():
    case = OpCase("grid_attention", MAPS | {"grid": 0})
    with pytest.raises(InputError, match="grid=0"):
        make_rows(case, PRECISIONS, LOOP_TOKENS, CPU)


def test_the_plane_sweep_finds_the_wall():
    sizes = {"batch": 2, "views": 4, "height": 24, "width": 32}
    case = PlaneSweepCase("plane_sweep", sizes | {"stride": 2, "planes": 24, "neighbors": 3})
    tensors = case.tensors()
    assert tensors["images"].min() >= 0 and tensors["images"].max() <= 1
    inverse_depths = case.run({name: tensor.float() for name, tensor in tensors.items()}, "cpu")
    assert torch.equal(inverse_depths[0], inverse_depths[1])
    cameras = Cameras(tensors["intrinsics"], tensors["cam_to_world"], 24, 32).resized(12, 16)
    # Along rays of z = 1: the wall is at z = DISTANCE + SLANT x.
    rotations = cameras.cam_to_world[..., None, None, :3, :3]
    rays = (rotations @ cameras.pixel_directions()[..., None])[..., 0]
    x, _, z = cameras.centers.unbind(-1)
    missing = (DISTANCE + SLANT * x - z)[..., None, None]
    depth = missing / (rays[..., 2] - SLANT * rays[..., 0])
    assert (inverse_depths * depth - 1).abs().median() < 0.03
