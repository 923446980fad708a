"""The backends under test, and their images and gradients of every input for a scene."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh")
INPUTS = (*FIELDS, "cam_to_world", "intrinsics", "background")
BACKGROUND = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)


@dataclass(frozen=True)
class Backend:
    name: str  # as `render` takes it
    dtype: torch.dtype  # what its inputs are given in
    image_error: float  # largest difference to the float64 reference, of values near 1
    gradient_error: float  # the same of a gradient, relative, L2
    many: int  # Gaussians of a scene of moderate size

    def __str__(self) -> str:
        return f"{self.name}-{str(self.dtype).removeprefix('torch.')}"


EXACT = Backend("reference", torch.float64, 1e-12, 1e-10, 400)
BACKENDS = (
    EXACT,
    Backend("reference", torch.float32, 2e-5, 2e-4, 400),
    Backend("cpu", torch.float32, 1e-6, 5e-6, 3000),
)
FAST = tuple(backend for backend in BACKENDS if backend.name != "reference")
# A process in which Triton interprets its kernels, see test_in_triton.py, tests them alone.
INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
if INTERPRETED:
    FAST = BACKENDS = (Backend("cuda", torch.float32, 1e-6, 5e-6, 60),)


@dataclass(frozen=True)
class Result:
    """A rendering, and the gradients of INPUTS from one gradient of its outputs."""

    outputs: dict[str, Tensor]
    grads: dict[str, Tensor]
    stats: dict[str, int]

    image = property(lambda self: self.outputs["image"])
    alpha = property(lambda self: self.outputs["alpha"])
    depth = property(lambda self: self.outputs["depth"])

    def is_finite(self) -> bool:
        return all(t.isfinite().all() for t in (*self.outputs.values(), *self.grads.values()))


def both_ways(
    backend: Backend,
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor = BACKGROUND,
    grad_output: Callable[[str, Tensor], Tensor | None] | None = None,
    inputs: tuple[str, ...] = INPUTS,
    **options,
) -> Result:
    """Render in the backend's float type, and compute the gradients of `inputs`.

    `grad_output` returns the gradient of an output from its name and value, None if it is unused.
    """
    leaves = [getattr(gaussians, name) for name in FIELDS]
    leaves += [cameras.cam_to_world, cameras.intrinsics, background]
    leaves = [leaf.detach().to(backend.dtype, copy=True) for leaf in leaves]
    leaves = dict(zip(INPUTS, leaves, strict=True))
    for name in inputs:
        leaves[name].requires_grad_()
    out = render(
        Gaussians(*(leaves[name] for name in FIELDS)),
        replace(cameras, intrinsics=leaves["intrinsics"], cam_to_world=leaves["cam_to_world"]),
        leaves["background"],
        backend=backend.name,
        **options,
    )
    outputs = {"image": out.image, "alpha": out.alpha, "depth": out.depth}
    outputs = {name: output for name, output in outputs.items() if output is not None}
    detached = {name: output.detach() for name, output in outputs.items()}
    grads = {name: (grad_output or random_gradient)(name, t) for name, t in detached.items()}
    grads = {name: grad for name, grad in grads.items() if grad is not None}
    grads = {k: t.to(backend.dtype) for k, t in grads.items() if outputs[k].requires_grad}
    of_inputs = torch.autograd.grad(
        [outputs[name] for name in grads],
        [leaves[name] for name in inputs],
        list(grads.values()),
        materialize_grads=True,
    )
    return Result(detached, dict(zip(inputs, of_inputs, strict=True)), out.stats)


def ones(name: str, output: Tensor) -> Tensor:
    return torch.ones_like(output)


def random_gradient(name: str, output: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(len(name))
    return torch.randn(output.shape, generator=generator, dtype=torch.float64)


def assert_same_bits(one: Result, other: Result, case: str = "") -> None:
    for own, others in ((one.outputs, other.outputs), (one.grads, other.grads)):
        for name, value in own.items():
            assert torch.equal(value, others[name]), f"{case}{name}"


def assert_close(
    backend: Backend, result: Result, exact: Result, slack: float = 1, names: tuple = INPUTS
) -> None:
    """Compare outputs to image_error and the named gradients to gradient_error of the backend."""
    for name, output in exact.outputs.items():
        bound = slack * backend.image_error * max(1, float(output.abs().amax()))
        assert max_error(result.outputs[name], output) <= bound, name
    for name in names:
        error = relative_error(result.grads[name], exact.grads[name])
        assert error <= slack * backend.gradient_error, name


def assert_exact(backend: Backend, *scene, slack=1.0, names=INPUTS, **options) -> Result:
    """Render with the backend, and compare outputs and gradients with the float64 reference."""
    result, exact = (both_ways(each, *scene, **options) for each in (backend, EXACT))
    assert result.is_finite()
    assert_close(backend, result, exact, slack, names)
    return result


def max_error(value: Tensor, exact: Tensor) -> float:
    return float((value.double() - exact.double()).abs().amax())


def relative_error(value: Tensor, exact: Tensor) -> float:
    """Compute the relative L2 error; 0 if both are 0."""
    difference = (value.double() - exact.double()).norm()
    return float(difference / exact.double().norm()) if difference > 0 else 0.0


def assert_as_without(result: Result, clean: Result, gone: int) -> None:
    for name, output in clean.outputs.items():
        assert torch.equal(result.outputs[name], output), name
    dim = result.alpha.ndim - 3  # of the Gaussians, after those of the batch
    for name, grad in clean.grads.items():
        own = result.grads[name]
        if name in FIELDS:
            assert (own.select(dim, gone) == 0).all(), name
            others = torch.arange(own.shape[dim]) != gone
            own = own.movedim(dim, 0)[others].movedim(0, dim)
        assert torch.equal(own, grad), name


def facing(cameras: Cameras) -> Cameras:
    """Move the cameras to the origin, facing along z, so that means are in their frame."""
    poses = torch.eye(4, dtype=cameras.cam_to_world.dtype).expand_as(cameras.cam_to_world)
    return replace(cameras, cam_to_world=poses.clone())
