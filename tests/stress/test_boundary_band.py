"""Images and gradients against the float64 reference: tight outside the boundary band, and flips
within it are counted."""

import pytest
import torch
from backends import EXACT, INPUTS, both_ways, random_gradient, relative_error

from asysplat.benchmark.scenes import pixel_aligned_scene, random_scene
from asysplat.benchmark.stability.boundary_band import boundary_band
from asysplat.rendering.interface import RenderSettings

SCENES = {
    "random": lambda count: random_scene(count, 96, 128),
    "pixel-aligned": lambda count: pixel_aligned_scene(int((count / 2) ** 0.5), 96, 128),
}
# Outputs that have a gradient, and options of `render`.
MODES = {
    "image": (("image",), {"depth": False}),
    "image, antialiased": (("image",), {"depth": False, "antialiased": True}),
    "alpha and depth": (("alpha", "depth"), {"depth": "expected"}),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("scene", SCENES)
def test_images_and_gradients_are_those_of_the_reference(fast_backend, scene, mode):
    gaussians, cameras = SCENES[scene](fast_backend.many)
    outputs, options = MODES[mode]
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
    flips = int((difference > 1e-6).sum())
    tight = float(difference[~band].max())
    print(f"\n{fast_backend}: band {int(band.sum())} of {band.numel()} pixels, ", end="")
    print(f"{flips} flips, largest error outside {tight:.1e}")
    assert band.float().mean() < 0.02
    assert tight <= 1e-6
    assert flips < 1e-4 * band.numel()
    errors = {name: relative_error(result.grads[name], exact.grads[name]) for name in INPUTS}
    print(", ".join(f"{name} {error:.1e}" for name, error in errors.items()))
    assert max(errors.values()) <= 5e-6
