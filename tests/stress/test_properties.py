"""Properties of any scene: equivalent scenes have the same image and gradients."""

from dataclasses import replace

import pytest
import torch
from backends import (
    BACKENDS,
    FIELDS,
    INTERPRETED,
    assert_close,
    both_ways,
    max_error,
    random_gradient,
    relative_error,
)
from hypothesis import given, settings
from hypothesis import strategies as st

few = settings(max_examples=1 if INTERPRETED else 3, derandomize=True, deadline=None)
seeds = st.integers(0, 10**6)
per_backend = pytest.mark.parametrize("backend", BACKENDS, ids=str)


def loosely(backend):
    """An equivalent scene is rounded differently: its errors are those of float32 inputs."""
    return max(backend.image_error, 1e-5 if backend.dtype == torch.float32 else 1e-11)


@per_backend
@few
@given(seed=seeds, batch=st.integers(1, 3), views=st.integers(1, 3))
def test_scenes_of_a_batch_are_independent(make_scene, backend, seed, batch, views):
    scenes = [make_scene(views=views, seed=seed + b) for b in range(batch)]
    gaussians, cameras = (type(parts[0]).stack(parts) for parts in zip(*scenes, strict=True))
    together = both_ways(backend, gaussians, cameras)
    random = {name: random_gradient(name, output) for name, output in together.outputs.items()}
    for b, scene in enumerate(scenes):
        alone = both_ways(backend, *scene, grad_output=lambda name, _, b=b: random[name][b])
        for name, output in alone.outputs.items():
            error = max_error(output, together.outputs[name][b])
            assert error <= backend.image_error * max(1, output.max()), name
        for name in (*FIELDS, "cam_to_world", "intrinsics"):
            error = relative_error(alone.grads[name], together.grads[name][b])
            assert error <= backend.gradient_error, name


@per_backend
@few
@given(seed=seeds, left=st.integers(0, 20), top=st.integers(0, 20))
def test_cropping_an_image(make_scene, backend, seed, left, top):
    """A window of the image equals the image of a camera with a shifted principal point. All means
    are inside both images, where the Jacobian is not clamped."""
    gaussians, cameras = make_scene(height=45, width=45, seed=seed)
    means = gaussians.means.clone()
    means[:, :2] = means[:, 2:] * means[:, :2].tanh() * 0.1
    gaussians = replace(gaussians, means=means, scales=gaussians.scales * 0.3)
    poses = torch.eye(4, dtype=torch.float64)[None]
    cameras = replace(cameras, cam_to_world=poses)
    cameras.intrinsics[:, 0, 2] = cameras.intrinsics[:, 1, 2] = 22.3
    window = replace(cameras, intrinsics=cameras.intrinsics.clone(), height=25, width=25)
    window.intrinsics[:, 0, 2] -= left
    window.intrinsics[:, 1, 2] -= top

    def cut(output):
        return output[..., top : top + 25, left : left + 25]

    def window_gradient(name, output):
        grad = torch.zeros(output.shape, dtype=torch.float64)
        cut(grad)[:] = random_gradient(name, cut(output))
        return grad

    whole = both_ways(backend, gaussians, cameras, grad_output=window_gradient)
    part = both_ways(backend, gaussians, window)
    for name, output in part.outputs.items():
        error = max_error(output, cut(whole.outputs[name]))
        assert error <= loosely(backend) * max(1, output.max()), name
    for name, grad in part.grads.items():
        assert relative_error(grad, whole.grads[name]) <= 10 * loosely(backend), name


@per_backend
@few
@given(
    seed=seeds,
    views=st.integers(2, 9),
    at_once=st.integers(1, 4),
    depth=st.sampled_from([False, "expected", "accumulated", "median"]),
    antialiased=st.booleans(),
)
def test_deferred_backpropagation_has_the_gradient_of_all_views_at_once(
    make_scene, backend, seed, views, at_once, depth, antialiased
):
    """Drawing a few views at a time, twice, gives the gradient of all at once."""
    gaussians, cameras = make_scene(views=views, seed=seed)
    options = {"depth": depth, "antialiased": antialiased}
    plain = both_ways(backend, gaussians, cameras, **options)
    chunked = both_ways(backend, gaussians, cameras, views_at_once=at_once, **options)
    for name in ("visible", "pairs", "tile_size"):
        assert chunked.stats[name] == plain.stats[name]
    assert_close(backend, chunked, plain)
