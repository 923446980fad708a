"""Means over images and over scenes."""

import math

import pytest

from asysplat.evaluation.rows import average


def rows(scenes, **columns):
    return [
        {"set": "main", "scene": scene, "view": view}
        | {name: values[view] for name, values in columns[scene].items()}
        for scene in scenes
        for view in range(len(next(iter(columns[scene].values()))))
    ]


SCENES = {
    "kitchen": {"psnr": [10.0, 20.0, 30.0], "absrel": [0.1, math.nan, 0.3]},
    "hall": {"psnr": [40.0], "absrel": [math.nan]},
    "street": {"psnr": [30.0, 50.0], "absrel": [0.8, 0.6]},
}


def test_scenes_of_different_numbers_of_images():
    found = {over: average(rows(SCENES, **SCENES), over) for over in ("images", "scenes")}
    assert found["images"]["psnr"] == pytest.approx((10 + 20 + 30 + 40 + 30 + 50) / 6)
    assert found["scenes"]["psnr"] == pytest.approx((20 + 40 + 40) / 3)
    # Scenes without known depth are left out.
    assert found["images"]["absrel"] == pytest.approx((0.1 + 0.3 + 0.8 + 0.6) / 4)
    assert found["scenes"]["absrel"] == pytest.approx((0.2 + 0.7) / 2)


def test_a_column_that_a_scene_lacks():
    scenes = SCENES | {"hall": {"psnr": [40.0]}}
    found = average(rows(scenes, **scenes), "scenes")
    assert found["absrel"] == pytest.approx((0.2 + 0.7) / 2)
    assert average([], "scenes") == {}
