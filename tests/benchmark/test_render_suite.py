"""The suite on a tiny scene, and what benchmark.py says to a user."""

from functools import partial

import pytest
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
from benchmarks.scenes import SCENES, SMALLER, pixel_aligned_scene, random_scene


@pytest.fixture(scope="module")
def results(run_suite):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCENES, "tiny", partial(random_scene, 500, 24, 40))
        patch.setitem(SCENES, "twin", partial(pixel_aligned_scene, 16, 32, 32))
        patch.setitem(SMALLER, "twin", partial(pixel_aligned_scene, 8, 16, 16))
        return run_suite("render", {"scenes": ["tiny", "twin"]})


@pytest.mark.medium
def test_rows_are_complete_and_culling_leaves_the_error_unchanged(results):
    assert {"cpu", "cores", "threads", "torch", "numba"} <= results["machine"].keys()
    rows = {(row["scene"], row["backend"], row["without"]): row for row in results["rows"]}
    assert len(rows) == len(results["rows"])
    for (scene, _, _), row in rows.items():
        size = {"tiny": (500, 24, 40), "twin": (512, 32, 32)}[scene]
        assert (row["gaussians"], row["height"], row["width"]) == size and row["views"] == 1
        assert row["error"]["measured_on"]["gaussians"] == {"tiny": 500, "twin": 128}[scene]
        assert row["error"]["gradients"].keys() == set(FIELDS)
        assert 0 <= row["error"]["image_p99"] <= row["error"]["image_max"]
        assert {"visible", "pairs", "tile_size"} <= row["stats"].keys()
        assert row["forward"].keys() == row["backward"].keys() == {"median", "iqr", "busy"}
    for scene in ("tiny", "twin"):
        assert (scene, "reference", None) in rows
        of_cpu = {off: rows[scene, "cpu", off] for off in (None, *CULLING)}
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


def test_mistakes_are_named(run_script, tmp_path):
    known = (
        "render, ops, model, data, formats, pareto, systems, bench, device, stability, machine_code"
    )
    with pytest.raises(InputError, match=rf"^suite=rendr is unknown: choose from {known}\.$"):
        find_suite("rendr")
    with pytest.raises(InputError, match=r"^scenes=D is unknown: .*A, B, C, 524k, 4M"):
        measure(OmegaConf.create({"scenes": ["A", "D"]}), Console(quiet=True))
    done = run_script("benchmark.py", "repeats=0", f"output={tmp_path}")
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: repeats=0 cannot be")
    assert not list(tmp_path.iterdir())
