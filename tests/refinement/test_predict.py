"""Gaussians of photographs in so many seconds."""

import itertools
import sys

import pytest
import torch

from asysplat import load
from asysplat.data import ProceduralScene
from asysplat.errors import InputError
from asysplat.evaluation.metrics import psnr
from asysplat.refinement import BRIEF, DEFAULT, FEW, predict, predict_in_windows, refine
from asysplat.refinement.init import gaussians_of_pixels, initial_gaussians, sweep
from asysplat.rendering import render


def held_out_psnr(scene, room):
    inputs, held_out = room
    image = render(scene, held_out.cameras, inputs.mean_color()).image.clamp(0, 1)
    return psnr(image, held_out.images).mean().item()


@pytest.mark.medium
def test_few_steps_gain_more_where_they_are_all_there_is(room):
    values = []
    for settings in (BRIEF, DEFAULT):
        start = initial_gaussians("plane_sweep", room[0], settings.initial_limit)
        values.append(held_out_psnr(refine(start, room[0], settings, steps=20), room))
    assert values[0] > values[1] + 1, values


@pytest.mark.parametrize(
    "seconds, count, expected", [(1, 12, BRIEF), (8, 12, DEFAULT), (8, 4, FEW)]
)
def test_the_time_and_the_views_choose_the_settings(monkeypatch, room, seconds, count, expected):
    taken = []

    def record(start, views, settings, **options):
        taken.append((settings, options))
        return start

    monkeypatch.setattr(sys.modules["asysplat.refinement.predict"], "refine", record)
    scene = predict(room[0].select(list(range(count))), seconds, seed=3)
    ((settings, options),) = taken
    assert settings == expected and options["seed"] == 3 and 0 < options["seconds"] < seconds
    assert scene.num_gaussians <= settings.initial_limit


def test_a_caller_without_gradients_gets_the_same(room):
    start = initial_gaussians("plane_sweep", room[0], 100)
    expected = refine(start, room[0], BRIEF, steps=2)
    with torch.no_grad():
        assert refine(start, room[0], BRIEF, steps=2).means.equal(expected.means)


def test_without_time_for_steps_it_is_the_plane_sweep_unmerged(room):
    sharp, estimate = predict(room[0], 1e-9), sweep(room[0])
    assert sharp.means.equal(gaussians_of_pixels(room[0], estimate).means)
    limit = BRIEF.initial_limit
    merged = initial_gaussians("plane_sweep", room[0], limit, estimate=estimate)
    assert merged.means.equal(initial_gaussians("plane_sweep", room[0], limit).means)
    assert held_out_psnr(sharp, room) > held_out_psnr(merged, room) + 1
    with pytest.raises(InputError, match="seconds"):
        predict(room[0], 0)


@pytest.mark.medium
def test_windows_are_as_good_as_the_whole():
    network, views_at_once, differences = load("shipped"), [], []
    network.register_forward_pre_hook(lambda _, views: views_at_once.append(views[0].num_views))
    for seed, places in itertools.product((0, 1), ("rooms", "outdoors")):
        scene = ProceduralScene(seed, 45, 60, 48, places=places)
        views = scene.views(range(0, 46, 2)), scene.views(range(3, 48, 8))
        whole, halves = (predict_in_windows(network, views[0], window) for window in (23, 12))
        differences.append(held_out_psnr(halves, views) - held_out_psnr(whole, views))
        assert halves.num_gaussians < 0.7 * whole.num_gaussians
    assert sum(differences) / len(differences) > -0.2, differences
    assert views_at_once == [23, 12, 11] * 4
