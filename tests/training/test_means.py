"""Means over images and over scenes, and that a run's protocol is part of what it is."""

import math

import pytest
from hydra import compose, initialize_config_dir

from asysplat.evaluation.rows import average
from asysplat.training.runs import config_hash


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
    # A scene without a known depth has no say.
    assert found["images"]["absrel"] == pytest.approx((0.1 + 0.3 + 0.8 + 0.6) / 4)
    assert found["scenes"]["absrel"] == pytest.approx((0.2 + 0.7) / 2)


def test_a_scene_without_a_column_has_no_say_in_it():
    scenes = SCENES | {"hall": {"psnr": [40.0]}}
    found = average(rows(scenes, **scenes), "scenes")
    assert found["absrel"] == pytest.approx((0.2 + 0.7) / 2)
    assert average([], "scenes") == {}


def test_runs_of_two_protocols_are_two(repository):
    choices = ([], ["metrics=longlrm"], ["metrics.depth_alignment=median"], ["metrics=default"])
    with initialize_config_dir(str(repository / "conf"), version_base=None):
        found = [config_hash(compose("train", [*choice, "paths.run=unused"])) for choice in choices]
    assert len(set(found)) == 3 and found[0] == found[3]
