"""Refinement on a device other than the CPU: nothing is left behind on the CPU."""

from dataclasses import replace

import pytest
import torch
from pretend_device import DEVICE, pretended_device
from test_refine import small_scene, small_views

from asysplat.errors import InputError
from asysplat.refinement import DEFAULT, StepSchedule, refine


@pytest.fixture
def scene():
    """Gaussians, and photographs of noise with masks."""
    gaussians = small_scene(60)
    gaussians.opacities[:] = torch.linspace(0.001, 0.9, 60)
    gaussians.scales.fill_(0.03)  # far from the limit above which they are pruned
    return gaussians, replace(small_views(3), masks=torch.rand(3, 12, 15) > 0.1)


def watched(gaussians, views, settings):
    """Refine, and return the last progress, too."""
    progress = []
    found = refine(gaussians, views, settings, steps=12, watch=lambda now, _: progress.append(now))
    return found, progress[-1]


@pytest.mark.parametrize("densify", ["error", "mcmc", "gradient", "none"])
def test_a_refinement_runs_where_its_inputs_are(scene, monkeypatch, densify):
    gaussians, views = scene
    schedule = StepSchedule(first_round=2, round=2, opacity_reset=5, sh_degree=2)
    settings = replace(
        DEFAULT,
        densify=densify,
        max_gaussians=100,
        ssim=0.2,
        every=schedule if densify == "gradient" else None,
        rates=replace(DEFAULT.rates, poses=1e-4),
    )
    expected, status = watched(gaussians, views, settings)
    with pretended_device(monkeypatch) as device:
        found, status_there = watched(gaussians.to(device), views.to(device), settings)
    assert found.means.device == DEVICE
    # In float32 a kernel and torch's operators part after some steps of Adam.
    assert status_there.psnr == pytest.approx(status.psnr, abs=0.02)
    assert status_there.gaussians == status.gaussians == expected.num_gaussians


def test_inputs_on_two_devices_are_refused(scene, monkeypatch):
    gaussians, views = scene
    with (
        pretended_device(monkeypatch) as device,
        pytest.raises(InputError, match=r"^refine's views is on cpu and gaussians on ipu"),
    ):
        refine(gaussians.to(device), views, steps=1)
