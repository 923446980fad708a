"""Results of scenes, put together for each set."""

import pytest

from asysplat.evaluation.post_optimization import SceneResult
from asysplat.evaluation.scenes import image_rows, set_results


def result(scene, psnrs, seconds):
    """A scene with a target for each PSNR, and an input that is 1 dB better."""
    rows = []
    for method, gain in (("post0", 0.0), ("post3", 2.0)):
        for view, psnr in enumerate(psnrs):
            rows.append({"images": "targets", "view": view, "method": method, "psnr": psnr + gain})
        rows.append({"images": "inputs", "view": 0, "method": method, "psnr": psnrs[0] + gain + 1})
    rows.append({"images": "targets", "view": 0, "method": "mean_color", "psnr": 5.0})
    costs = {
        "post0": {"seconds": seconds, "gb": 1.0},
        "post3": {"seconds": 2 * seconds, "gb": seconds},
    }
    return SceneResult(scene, 100, costs, rows)


SCENES = {
    "main": [result("a", [10.0, 20.0], 1.0), result("b", [30.0], 3.0), result("c", [40.0], 9.0)],
    "other": [result("d", [50.0], 4.0)],
}


def test_results_of_a_set_are_means_over_its_scenes():
    found = set_results(SCENES, "images")
    assert found["test/main/post0/psnr"] == pytest.approx(25)
    assert found["test/main/post3/psnr"] == pytest.approx(27)
    assert found["inputs/main/post3/psnr"] == pytest.approx((13 + 33 + 43) / 3)
    assert found["baseline/main/mean_color/psnr"] == 5
    # The longest of three does not count, as the one that may have compiled.
    assert (found["cost/post0/seconds"], found["cost/post3/seconds"]) == (2, 4)
    assert (found["cost/post3/gb"], found["cost/gaussians"]) == (9, 100)
    assert found["test/other/post3/psnr"] == 52 and found["cost/other/post3/seconds"] == 8
    assert set_results(SCENES, "scenes")["test/main/post0/psnr"] == pytest.approx(85 / 3)
    assert len(image_rows(SCENES)) == 4 * 2 * 2 + 2 + 4
