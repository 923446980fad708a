"""Exact culling: the same bits without each kind, and every kind saves work."""

from dataclasses import fields

import pytest
import torch
from backends import assert_same_bits, both_ways

from asysplat.rendering.interface import Culling, without_culling
from benchmarks.scenes import pixel_aligned_scene, random_scene


def needles():
    """Faint, opaque and long: work for every kind of culling."""
    gaussians, cameras = random_scene(1500, 96, 128)
    gaussians.scales[:, 0] *= 6
    gaussians.opacities[::5] = 1e-3
    gaussians.opacities[1::5] = 0.02
    gaussians.opacities[2::5] = 1.0
    return gaussians, cameras


MASKS = torch.ones(1, 96, 128, dtype=torch.bool)
MASKS[:, :40, 20:100] = False
# The work that each kind saves, from the statistics with it and without it.
GAINS = {
    "opacity": lambda with_it, _: with_it["culled_by_opacity"],
    "frustum": lambda with_it, _: with_it["culled_by_frustum"],
    "extent": lambda with_it, without: without["pairs"] - with_it["pairs"],
    "ellipse": lambda with_it, _: with_it["pairs_culled_by_ellipse"],
    "masks": lambda with_it, _: with_it["pairs_culled_by_masks"],
    "rows": lambda with_it, _: with_it["rows_culled_by_extent"],
    "opaque": lambda with_it, _: (
        with_it["rows_culled_by_opaque"] + with_it["pairs_culled_by_opaque"]
    ),
}


@pytest.mark.parametrize("scene", ["needles", "pixel-aligned"])
def test_each_kind_saves_work_and_changes_no_bit(fast_backend, scene):
    gaussians, cameras = needles() if scene == "needles" else pixel_aligned_scene(40, 96, 128)
    options = {} if scene == "needles" else {"depth": "median", "antialiased": True}
    options["masks"] = MASKS
    plain = both_ways(fast_backend, gaussians, cameras, **options)
    assert (plain.alpha > 0.999).any() and (plain.alpha[~MASKS] == 0).all()
    names = [field.name for field in fields(Culling)]
    assert names == list(GAINS)
    for off in (*([name] for name in names), names):
        with without_culling(*off):
            without = both_ways(fast_backend, gaussians, cameras, **options)
        assert_same_bits(without, plain, f"without {off}: ")
        if scene == "needles" and len(off) == 1:
            gain = GAINS[off[0]]
            assert gain(plain.stats, without.stats) > 0, off
            assert gain(without.stats, without.stats) == 0, off
