"""What compressed formats share."""

import torch

from asysplat.export.formats.packing import half_turn, join_largest, morton_order, split_largest
from asysplat.geometry.motion import rotations
from asysplat.geometry.spherical_harmonics import sh_colors


def test_the_morton_order_is_that_of_interleaved_bits():
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    expected = sorted(
        range(64),
        key=lambda i: sum(
            (int(grid[i, axis]) >> bit & 1) << 3 * bit + axis for bit in (0, 1) for axis in range(3)
        ),
    )
    assert morton_order(grid).tolist() == expected
    assert morton_order(torch.ones(3, 3)).tolist() == [0, 1, 2]


def test_rotations_come_back_from_their_three_small_components():
    quats = torch.randn(1000, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    quats = torch.cat((quats, torch.eye(4), -torch.eye(4), torch.full((1, 4), 0.5)))
    largest, rest = split_largest(quats)
    assert rest.abs().max() <= 0.5**0.5 + 1e-12
    back = join_largest(largest.numpy(), rest.numpy())
    torch.testing.assert_close(rotations(back), rotations(quats))


def test_a_half_turn_turns_places_axes_and_colors(make_scene):
    scene, _ = make_scene(degree=3)
    for axis in range(3):
        turn = -torch.eye(3, dtype=torch.float64)
        turn[axis, axis] = 1
        turned = half_turn(scene, axis)
        assert torch.equal(turned.means, scene.means @ turn)
        axes = rotations(scene.quats) * scene.scales[:, None]
        turned_axes = rotations(turned.quats) * turned.scales[:, None]
        torch.testing.assert_close(turned_axes @ turned_axes.mT, turn @ axes @ axes.mT @ turn)
        directions = torch.randn(len(scene.means), 3, dtype=torch.float64)
        torch.testing.assert_close(
            sh_colors(turned.sh, directions @ turn), sh_colors(scene.sh, directions)
        )
        assert torch.equal(half_turn(turned, axis).sh, scene.sh)
