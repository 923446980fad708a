"""The same bits on any number of threads and in every run, and for equal depths an order."""

import pytest
import torch
from backends import EXACT, FAST, FIELDS, INTERPRETED, assert_same_bits, both_ways, max_error
from tangents import tangent_scene

from benchmarks.scenes import random_scene


@pytest.mark.medium
def test_any_number_of_threads_gives_the_same_bits(backend, threads):
    scenes = [random_scene(backend.many, 48, 64, seed) for seed in range(2)]
    gaussians, cameras = (type(parts[0]).stack(parts) for parts in zip(*scenes, strict=True))
    cameras = cameras.map(lambda t: t.repeat(1, 2, 1, 1))
    cameras.cam_to_world[:, 1, 0, 3] = 0.5
    assert_any_threads_agree(backend, (gaussians, cameras), threads)


@pytest.mark.medium
@pytest.mark.skipif(INTERPRETED, reason="too many for the interpreter")
def test_renderings_of_splats_that_end_at_the_edges_of_tiles_are_the_same(threads):
    cpu = next(backend for backend in FAST if backend.name == "cpu")
    found = assert_any_threads_agree(cpu, tangent_scene(40_000, 256, 256), threads)
    assert found.stats["pairs"] > 80_000


def assert_any_threads_agree(backend, scene, threads):
    threads(1)
    one = both_ways(backend, *scene)
    for count in (1, 2, 1, 2):
        threads(count)
        found = both_ways(backend, *scene)
        assert_same_bits(found, one, f"{count} threads: ")
        assert found.stats == one.stats
    return one


def test_equal_depths_are_drawn_by_index(backend, make_scene):
    """Copies at one place composite like separate images, the first in front."""
    gaussians, cameras = make_scene(count=1, dtype=torch.float32)
    gaussians = gaussians.map(lambda t: t.repeat(3, *(1,) * (t.ndim - 1)))
    gaussians.sh[:] = torch.randn(3, 4, 3)
    black = torch.zeros(3)
    single = [
        both_ways(backend, gaussians.keep(torch.arange(3) == i), cameras, black) for i in range(3)
    ]
    left, expected = 1, 0
    for one in single:
        expected = expected + left * one.image
        left = left * (1 - one.alpha)
    for order in ([0, 1, 2], [2, 0, 1]):
        shuffled = gaussians.map(lambda t, order=order: t[order])
        result = both_ways(backend, shuffled, cameras, black)
        same = max_error(result.image, expected) <= 2 * backend.image_error
        assert same == (order == [0, 1, 2])


@pytest.mark.parametrize("ties", [False, True])
def test_the_order_of_the_input_changes_nothing_else(backend, make_scene, ties):
    """Pairs at one depth keep their order; their gradients move with them."""
    gaussians, cameras = make_scene(count=40, views=2, dtype=torch.float32)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(3))
    if ties:
        gaussians = gaussians.map(lambda t: t.repeat_interleave(2, 0))
        gaussians.sh[1::2] *= -1
        order = (2 * order[:, None] + torch.arange(2)).flatten()
    result = both_ways(backend, gaussians.map(lambda t: t[order]), cameras)
    plain = both_ways(backend, gaussians, cameras)
    for name, output in plain.outputs.items():
        assert max_error(result.outputs[name], output) <= backend.image_error, name
    for name in FIELDS:
        torch.testing.assert_close(
            result.grads[name], plain.grads[name][order], rtol=1e-4, atol=1e-4, msg=name
        )
    exact = both_ways(EXACT, gaussians, cameras)
    assert max_error(result.image, exact.image) <= backend.image_error
