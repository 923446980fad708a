"""What holds for every camera path: valid cameras whatever is given, and mistakes refused."""

import pytest
import torch
from placed import HARD, cameras_at, ring

from asysplat.errors import InputError
from asysplat.export import orbit, smoothed_path
from asysplat.scene import Cameras

PATHS = [smoothed_path, orbit]


@pytest.mark.parametrize("frames", [1, 2, 25])
@pytest.mark.parametrize("case", HARD)
@pytest.mark.parametrize("path", PATHS)
def test_cameras_can_be_rendered_whatever_is_given(path, case, frames):
    made = path(HARD[case], frames).validate()
    assert made.num_views == frames
    assert (made.height, made.width) == (HARD[case].height, HARD[case].width)
    assert made.cam_to_world.dtype == torch.float32


@pytest.mark.parametrize("path", PATHS)
def test_intrinsics_are_the_mean(path):
    cameras = cameras_at(ring([0, 10, 20]), [[0, 0, 0]] * 3)
    cameras.intrinsics[:, 0, 0] = torch.tensor([40.0, 50, 90])
    made = path(cameras, 4)
    assert torch.equal(made.intrinsics, cameras.intrinsics.mean(0).expand(4, 3, 3))
    assert made.intrinsics[0, 0, 0] == 60


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    ("change", "frames", "message"),
    [
        (lambda c: c, 0, "frames is 0"),
        (lambda c: Cameras.stack([c, c]), 5, r"shape \(2, 3, 3, 3\): expected \[V, 3, 3\]"),
        (lambda c: c.select(torch.zeros(0, dtype=torch.long)), 5, r"shape \(0, 3, 3\)"),
        (lambda c: c.map(lambda t: t * torch.nan), 5, "holds NaN"),
    ],
)
def test_mistakes_are_refused(path, change, frames, message):
    with pytest.raises(InputError, match=message):
        path(change(cameras_at(ring([0, 10, 20]))), frames)
