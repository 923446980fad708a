"""Exact culling: the same bits without each kind, and every kind saves work."""

from dataclasses import fields

import pytest
import torch
from backends import assert_same_bits, both_ways

from asysplat.benchmark.scenes import pixel_aligned_scene, random_scene
from asysplat.rendering import Culling


def needles():
    """Faint, opaque and long: work for every kind of culling."""
    gaussians, cameras = random_scene(1500, 96, 128)
    gaussians.scales[:, 0] *= 6
    gaussians.opacities[::5] = 1e-3
    gaussians.opacities[1::5] = 0.02
    gaussians.opacities[2::5] = 1.0
    return gaussians, cameras


SCENES = {"needles": needles, "pixel-aligned": lambda: pixel_aligned_scene(40, 96, 128)}
NAMES = [field.name for field in fields(Culling)]
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


@pytest.mark.parametrize("options", [{}, {"depth": "median", "antialiased": True}], ids=str)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", [*NAMES, "all"])
def test_bits_are_the_same_without(fast_backend, name, scene, options):
    gaussians, cameras = SCENES[scene]()
    options = {"masks": MASKS, **options}
    plain = both_ways(fast_backend, gaussians, cameras, **options)
    assert (plain.alpha > 0.999).any() and (plain.alpha[~MASKS] == 0).all()
    culling = Culling(**dict.fromkeys(NAMES if name == "all" else [name], False))
    assert_same_bits(both_ways(fast_backend, gaussians, cameras, culling=culling, **options), plain)


@pytest.mark.parametrize("name", NAMES)
def test_each_kind_saves_work_and_counts_it(fast_backend, name):
    gaussians, cameras = needles()
    culling = Culling(**{name: False})
    with_it = both_ways(fast_backend, gaussians, cameras, masks=MASKS).stats
    without = both_ways(fast_backend, gaussians, cameras, masks=MASKS, culling=culling).stats
    assert with_it != without
    assert GAINS[name](with_it, without) > 0
    assert GAINS[name](without, without) == 0
