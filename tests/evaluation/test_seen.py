"""Which pixels of a view some input photograph shows, too."""

import torch

from asysplat.evaluation.seen import seen_by_inputs
from asysplat.scene import Cameras


def looking_along_z(*positions):
    """Cameras of 20x20 pixels that see as far to each side as ahead, at positions along x."""
    intrinsics = torch.tensor([[10.0, 0, 10], [0, 10, 10], [0, 0, 1]]).expand(len(positions), 3, 3)
    poses = torch.eye(4).repeat(len(positions), 1, 1)
    poses[:, 0, 3] = torch.tensor(positions)
    return Cameras(intrinsics, poses, 20, 20)


def test_a_wall_is_seen_where_an_input_looks_and_nothing_is_in_its_way():
    wall = torch.full((1, 20, 20), 2.0)
    held, inputs = looking_along_z(1.0), looking_along_z(0.0)
    seen = seen_by_inputs(wall, held, wall, inputs)[0]
    # The wall is 4 wide in each, so that 3/4 of it are in both.
    assert seen[:, :15].all() and not seen[:, 15:].any()
    hidden = wall.clone()
    hidden[:, :10] = 1.0  # something before the upper half of the input
    seen = seen_by_inputs(wall, held, hidden, inputs)[0]
    assert not seen[:10].any() and seen[10:, :15].all()
    both = seen_by_inputs(wall, held, torch.cat((hidden, wall)), looking_along_z(0.0, 2.0))[0]
    assert both[:, 5:].all() and not both[:10, :5].any()


def test_nothing_is_seen_where_nothing_is():
    empty = torch.zeros(1, 20, 20)
    assert not seen_by_inputs(empty, looking_along_z(0.5), empty, looking_along_z(0.0)).any()
