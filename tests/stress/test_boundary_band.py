"""Images and gradients against the float64 reference: tight outside the boundary band, and flips
within it are counted."""

import pytest
import torch
from backends import EXACT, INPUTS, both_ways, random_gradient, relative_error

from asysplat.rendering.interface import RenderSettings
from benchmarks.scenes import pixel_aligned_scene, random_scene
from benchmarks.stability.boundary_band import boundary_band

# Outputs that have a gradient, and options of `render`.
CASES = {
    "random, depth": (("alpha", "depth"), {"depth": "expected"}),
    "pixel-aligned, antialiased": (("image",), {"depth": False, "antialiased": True}),
}


@pytest.mark.medium
@pytest.mark.parametrize("case", CASES)
def test_images_and_gradients_are_those_of_the_reference(fast_backend, case):
    outputs, options = CASES[case]
    if case.startswith("random"):
        gaussians, cameras = random_scene(fast_backend.many, 96, 128)
    else:
        gaussians, cameras = pixel_aligned_scene(int((fast_backend.many / 2) ** 0.5), 96, 128)
    settings = RenderSettings(antialiased=options.get("antialiased", False))
    band = boundary_band(gaussians, cameras, settings)

    def grad_output(name, output):
        at_band = band[:, None] if name == "image" else band
        return random_gradient(name, output) * ~at_band * float(name in outputs)

    result = both_ways(fast_backend, gaussians, cameras, grad_output=grad_output, **options)
    exact = both_ways(EXACT, gaussians, cameras, grad_output=grad_output, **options)
    differences = [(result.image.double() - exact.image).abs().amax(1)]
    differences += [
        (result.outputs[name].double() - exact.outputs[name]).abs() / exact.outputs[name].max()
        for name in exact.outputs
        if name != "image"
    ]
    difference = torch.stack(differences).amax(0)
    assert band.float().mean() < 0.02
    assert difference[~band].max() <= 1e-6
    assert (difference > 1e-6).sum() < 1e-4 * band.numel()
    for name in INPUTS:
        assert relative_error(result.grads[name], exact.grads[name]) <= 5e-6, name
