"""Images and gradients against the float64 reference: tight outside the boundary band, and flips
within it are counted."""

from dataclasses import dataclass
from functools import cache

import pytest
import torch
from backends import EXACT, FIELDS, INPUTS, Backend, both_ways, random_gradient, relative_error
from torch import Tensor

from asysplat.benchmark.scenes import pixel_aligned_scene, random_scene
from asysplat.benchmark.stability.boundary_band import boundary_band
from asysplat.rendering.interface import RenderSettings

OTHERS = tuple(name for name in INPUTS if name not in FIELDS)
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


@dataclass(frozen=True)
class Comparison:
    """Of a backend with the reference: band and difference [V, H, W], relative gradient errors."""

    band: Tensor
    difference: Tensor
    grads: dict[str, float]


@cache
def compare(backend: Backend, scene: str, mode: str) -> Comparison:
    gaussians, cameras = SCENES[scene](backend.many)
    outputs, options = MODES[mode]
    settings = RenderSettings(antialiased=options.get("antialiased", False))
    band = boundary_band(gaussians, cameras, settings)

    def grad_output(name, output):
        at_band = band[:, None] if name == "image" else band
        return random_gradient(name, output) * ~at_band * float(name in outputs)

    result = both_ways(backend, gaussians, cameras, grad_output=grad_output, **options)
    exact = both_ways(EXACT, gaussians, cameras, grad_output=grad_output, **options)
    difference = [(result.image.double() - exact.image).abs().amax(1)]
    difference += [
        (result.outputs[name].double() - exact.outputs[name]).abs() / exact.outputs[name].max()
        for name in exact.outputs
        if name != "image"
    ]
    return Comparison(
        band,
        torch.stack(difference).amax(0),
        {name: relative_error(result.grads[name], exact.grads[name]) for name in INPUTS},
    )


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("scene", SCENES)
def test_images_are_those_of_the_reference_outside_the_band(fast_backend, scene, mode):
    found = compare(fast_backend, scene, mode)
    flips = int((found.difference > 1e-6).sum())
    tight = float(found.difference[~found.band].max())
    print(
        f"\n{fast_backend}: band {int(found.band.sum())} of {found.band.numel()} pixels, ", end=""
    )
    print(f"{flips} flips, largest error outside {tight:.1e}")
    assert found.band.float().mean() < 0.02
    assert tight <= 1e-6
    assert flips < 1e-4 * found.band.numel()


@pytest.mark.parametrize("inputs", [FIELDS, OTHERS], ids=["Gaussians", "cameras, background"])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("scene", SCENES)
def test_gradients_are_those_of_the_reference(fast_backend, scene, mode, inputs):
    found = compare(fast_backend, scene, mode)
    errors = {name: found.grads[name] for name in inputs}
    print(f"\n{fast_backend}:", ", ".join(f"{name} {error:.1e}" for name, error in errors.items()))
    assert max(errors.values()) <= 5e-6
