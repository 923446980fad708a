"""Images of odd sizes, many tiles, many pairs, many views."""

import numpy as np
import pytest
import torch
from backends import assert_close, assert_exact, both_ways, facing

from asysplat.errors import InputError
from asysplat.rendering import render
from asysplat.rendering.cpu.draw import _starts
from asysplat.rendering.interface import without_culling
from asysplat.rendering.render import BACKENDS
from asysplat.scene import Cameras, Gaussians


@pytest.mark.parametrize("height, width", [(1, 1), (1, 4096), (33, 1)])
def test_odd_sizes_agree_with_the_reference(backend, make_scene, height, width):
    gaussians, cameras = make_scene(count=6, height=height, width=width, dtype=torch.float32)
    result = assert_exact(backend, gaussians, cameras, slack=5)
    assert result.image.shape == (1, 3, height, width)
    assert (result.alpha > 0.1).any()


def test_more_tiles_than_16_bits_count(fast_backend, make_scene):
    """Columns of 16384 pixels in 65 views, of which the last alone sees anything."""
    gaussians, cameras = make_scene(count=3, views=65, height=16384, width=1, dtype=torch.float32)
    cameras = facing(cameras)
    cameras.intrinsics[:] = torch.tensor([[20.0, 0, 0.5], [0, 20, 16380], [0, 0, 1]])
    gaussians.means[:, :2] = 0
    cameras.cam_to_world[:-1, 2, 3] = 100  # behind all of it
    result = both_ways(fast_backend, gaussians, cameras)
    last = both_ways(fast_backend, gaussians, cameras.select([64]))
    assert result.stats["pairs"] == last.stats["pairs"]
    assert (result.alpha[:-1] == 0).all()
    assert (last.alpha[0, 16360:] > 0.1).any()
    for name, output in last.outputs.items():
        assert torch.equal(result.outputs[name][64:], output), name


@pytest.mark.slow
def test_pairs_that_no_list_can_number_are_refused():
    """2^31 and more of them, on the CPU: 33000 giants over 65536 tiles."""
    count = 33000
    giants = Gaussians(
        means=torch.tensor([0.0, 0, 1]).expand(count, 3),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        scales=torch.full((count, 3), 1e10),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 1, 3),
    )
    intrinsics = torch.tensor([[[100.0, 0, 2**19], [0, 100, 0.5], [0, 0, 1]]])
    cameras = Cameras(intrinsics, torch.eye(4)[None], 1, 2**20)
    message = rf"{count * 2**16} pairs.*2147483647.*views_at_once"
    with pytest.raises(InputError, match=message), without_culling("ellipse"):
        render(giants, cameras, backend="cpu")


def test_too_little_memory_is_met_by_fewer_views(backend, make_scene, monkeypatch):
    gaussians, cameras = make_scene(views=5)
    plain = both_ways(backend, gaussians, cameras)
    draw = BACKENDS[backend.name]

    def poor(gaussians, cameras, *rest):
        if cameras.num_views > 3:
            raise torch.OutOfMemoryError("no memory for more than 3 views")
        return draw(gaussians, cameras, *rest)

    monkeypatch.setitem(BACKENDS, backend.name, poor)
    with pytest.warns(UserWarning, match="memory does not hold.*drawing 3 at a time"):
        result = both_ways(backend, gaussians, cameras)
    assert_close(backend, result, plain)


def test_offsets_are_counted_in_64_bits():
    most = np.full(3, 2**31 - 1, np.int32)
    assert _starts(most).tolist() == [0, 2**31 - 1, 2 * (2**31 - 1), 3 * (2**31 - 1)]
