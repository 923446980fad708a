"""metrics.json and the terminal, of runs that measured everything and of those that did not."""

import json
import math

import pytest

from asysplat.evaluation.metrics import average
from asysplat.runs.summary import print_summary, write_json

METRICS = {
    "protocol/name": "longlrm",
    "test/rooms/psnr": 21.5,
    "baseline/rooms/nearest_view/psnr": 16.0,
    "baseline/rooms/mean_color/psnr": 13.0,
}
STATIC = {"cost/parameters": 2e6, "cost/geometry_ratio": 0.7, "cost/gaussians": 10}
STEP = {"cost/seconds_per_step": 2.0}
DEPTHS = {"test/rooms/absrel": 0.25, "baseline/rooms/mean_inverse_depth/absrel": 0.75}
OTHERS = {key.replace("rooms", "outdoors"): value for key, value in (METRICS | DEPTHS).items()}


@pytest.mark.parametrize(
    "results, shown, hidden",
    [
        (METRICS | {"missing/lpips": "x=y"}, ["LPIPS", "\nLPIPS: x=y.\n"], ["SSIM"]),
        (METRICS | STATIC | STEP, ["longlrm", "21.500", "2.00M", "2.00 s a step"], ["LPIPS"]),
        (METRICS | DEPTHS, ["AbsRel", "mean inverse depth", "0.750"], ["LPIPS"]),
        (METRICS | OTHERS, ["other test sets", "outdoors", "nearest"], ["AbsRel", "plane"]),
        (STATIC | STEP, ["2.00M", "2.00 s a step"], ["test scenes", "PSNR"]),
        ({}, [], ["parameters", "PSNR"]),
    ],
)
def test_what_was_not_measured_is_left_out(results, shown, hidden, tmp_path, capsys):
    print_summary(results, "rooms", tmp_path)
    printed = capsys.readouterr().out
    for words in shown:
        assert words in printed
    for words in hidden:
        assert words not in printed
    assert printed.splitlines()[-1] == f"run: {tmp_path}"


def test_stages_before_the_last_have_a_row_each(tmp_path, capsys):
    earlier = {"stage1/test/rooms/psnr": 19.25, "stage2/test/rooms/psnr": 20.75}
    print_summary(METRICS | earlier, "rooms", tmp_path)
    printed = capsys.readouterr().out.splitlines()
    rows = [[cell.strip() for cell in line.split("│")[1:3]] for line in printed if "│" in line]
    assert rows[:2] == [["after stage1", "19.250"], ["after stage2", "20.750"]]
    assert rows[2] == ["trained", "21.500"]


def test_metrics_json_is_finite_and_says_how_seconds_are_taken(tmp_path):
    path = tmp_path / "metrics.json"
    write_json(path, METRICS | {"test/rooms/absrel": float("nan")})
    found = json.loads(path.read_text())
    assert found["test/rooms/absrel"] is None and found["test/rooms/psnr"] == 21.5
    assert "longest" in found["protocol/seconds"]
    assert list(tmp_path.iterdir()) == [path]


PSNR = {"kitchen": [10.0, 20.0, 30.0], "hall": [40.0], "street": [30.0, 50.0]}
ABSREL = {"kitchen": [0.1, math.nan, 0.3], "hall": [math.nan], "street": [0.8, 0.6]}


@pytest.mark.parametrize("missing", [math.nan, None])
def test_scenes_of_different_numbers_of_images(missing):
    """Images without a known depth, and a scene without the column, are left out."""
    rows = [
        {"set": "main", "scene": scene, "view": view, "psnr": psnr, "absrel": ABSREL[scene][view]}
        for scene, psnrs in PSNR.items()
        for view, psnr in enumerate(psnrs)
    ]
    if missing is None:
        del rows[3]["absrel"]
    found = {over: average(rows, over) for over in ("images", "scenes")}
    assert found["images"]["psnr"] == pytest.approx((10 + 20 + 30 + 40 + 30 + 50) / 6)
    assert found["scenes"]["psnr"] == pytest.approx((20 + 40 + 40) / 3)
    assert found["images"]["absrel"] == pytest.approx((0.1 + 0.3 + 0.8 + 0.6) / 4)
    assert found["scenes"]["absrel"] == pytest.approx((0.2 + 0.7) / 2)
    assert average([], "scenes") == {}
