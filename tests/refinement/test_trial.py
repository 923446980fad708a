"""A trial of settings on photographs that sit out."""

import sys
from dataclasses import replace

import pytest

from asysplat.refinement import BRIEF
from asysplat.refinement.trial import trial_gain

trial = sys.modules["asysplat.refinement.trial"]
FADING = replace(BRIEF, opacity_decay=0.8)


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(trial, "STEPS", 20)


def test_better_settings_gain_what_worse_ones_lose_and_again(short, room):
    views = room[0]
    gain, error = trial_gain(views, FADING, BRIEF)
    assert gain > 1 > error > 0 and trial_gain(views, FADING, BRIEF) == (gain, error)
    assert trial_gain(views, BRIEF, FADING) == pytest.approx((-gain, error))
    assert trial_gain(views, BRIEF, BRIEF) == (0, 0)


def test_what_sits_out_measures_and_is_given_back(short, monkeypatch, room):
    views, fitted = room[0], []
    before = views.images.clone()
    refine = trial.refine

    def record(start, rest, *args, **options):
        fitted.append(rest)
        return refine(start, rest, *args, **options)

    monkeypatch.setattr(trial, "refine", record)
    gain = trial_gain(views, FADING, BRIEF)
    assert [rest.num_views for rest in fitted] == [9, 9] and views.images.equal(before)
    centers = {tuple(center) for center in views.cameras.centers.tolist()}
    sitting = centers - {tuple(center) for center in fitted[0].cameras.centers.tolist()}
    rows = [i for i, c in enumerate(views.cameras.centers.tolist()) if tuple(c) in sitting]
    assert len(rows) == 3 and min(rows) > 0 and max(rows) < 11
    images = before.clone()
    images[rows] = images[rows].flip(-1)
    spoiled = trial_gain(replace(views, images=images), FADING, BRIEF)
    assert spoiled != gain and fitted[2].images.equal(fitted[0].images)
