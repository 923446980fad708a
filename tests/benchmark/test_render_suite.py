"""The suite on a tiny scene, its scenes, and what benchmark.py says to a user."""

from functools import partial

import pytest
import torch
from omegaconf import OmegaConf
from rich.console import Console

from asysplat.errors import InputError
from benchmarks.options import find_suite
from benchmarks.render import (
    CULLING,
    FIELDS,
    find_backends,
    find_flips,
    measure,
    measure_errors,
    prepare_inputs,
    run_exact,
    run_passes,
)
from benchmarks.scenes import (
    DISTANCE,
    SCENES,
    SMALLER,
    pixel_aligned_scene,
    place_on_arc,
    random_scene,
)


@pytest.mark.medium
def test_rows_are_complete_and_culling_leaves_the_error_unchanged(run_suite, monkeypatch):
    monkeypatch.setitem(SCENES, "twin", partial(pixel_aligned_scene, 16, 32, 32))
    monkeypatch.setitem(SMALLER, "twin", partial(pixel_aligned_scene, 8, 16, 16))
    results = run_suite("render", {"scenes": ["twin"]})
    assert {"cpu", "cores", "threads", "torch", "numba"} <= results["machine"].keys()
    rows = {(row["backend"], row["without"]): row for row in results["rows"]}
    for row in rows.values():
        assert (row["gaussians"], row["height"], row["width"], row["views"]) == (512, 32, 32, 1)
        assert row["error"]["measured_on"]["gaussians"] == 128
        assert row["error"]["gradients"].keys() == set(FIELDS)
        assert 0 <= row["error"]["image_p99"] <= row["error"]["image_max"]
        assert {"visible", "pairs", "tile_size"} <= row["stats"].keys()
        assert row["forward"].keys() == row["backward"].keys() == {"median", "iqr", "busy"}
    assert ("reference", None) in rows
    of_cpu = {off: rows["cpu", off] for off in (None, *CULLING)}
    assert all(row["error"] == of_cpu[None]["error"] for row in of_cpu.values())
    assert of_cpu["rows"]["stats"]["rows"] > of_cpu[None]["stats"]["rows"]


def test_errors_are_those_of_image_and_gradients():
    scene = random_scene(200, 20, 20)
    exact = run_exact(scene)
    outputs = run_passes(find_backends()[0], prepare_inputs(scene))
    none = find_flips(exact, exact)
    close = measure_errors(outputs, exact, none)
    assert not none.any() and 0 < close["image_max"] < 1e-3
    assert max(close["gradients"].values()) < 1e-2

    image = exact.image.clone()
    image[0, 0, 0, 0] += 1
    gradients = (exact.gradients[0] * 1.5, *exact.gradients[1:])
    other = exact._replace(image=image, gradients=gradients)
    wrong = measure_errors(other, exact, none)
    assert wrong["image_max"] == pytest.approx(1) and wrong["image_p99"] == 0
    assert wrong["gradients"] == pytest.approx({name: 0.5 * (name == "means") for name in FIELDS})
    flipped = find_flips(other, exact)
    assert flipped.sum() == 1 and flipped[0, 0, 0]
    assert measure_errors(other, exact, flipped)["image_max"] == 0


@pytest.mark.parametrize("make, count, num", [(random_scene, 9, 9), (pixel_aligned_scene, 20, 800)])
def test_scenes_are_valid_and_visible_and_cameras_on_an_arc_look_at_their_middle(make, count, num):
    gaussians, camera = make(count, 54, 96)
    assert gaussians.validate().num_gaussians == num
    assert camera.project(gaussians.means)[2].float().mean() > 0.6
    cameras = place_on_arc(camera, 5)
    cameras.validate()
    middle = torch.tensor([0, 0, DISTANCE, 1])
    in_cameras = torch.linalg.inv(cameras.cam_to_world) @ middle
    torch.testing.assert_close(in_cameras, middle.expand(5, 4), rtol=0, atol=1e-5)


def test_mistakes_are_named(run_script, tmp_path):
    with pytest.raises(InputError, match=r"^suite=rendr is unknown: choose from render, ops, mode"):
        find_suite("rendr")
    with pytest.raises(InputError, match=r"^scenes=D is unknown: .*A, B, C, 524k, 4M"):
        measure(OmegaConf.create({"scenes": ["A", "D"]}), Console(quiet=True))
    done = run_script("benchmark.py", "repeats=0", f"output={tmp_path}")
    assert done.returncode == 1 and done.stderr.startswith("error: repeats=0 cannot be")
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
