"""What there is to say of a camera path, and of the sparse points along it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.scene import Cameras

SAME = 1e-6  # of the path's extent, and of a rotation's entries


@dataclass(frozen=True)
class CameraPath:
    """Lengths in scene units, angles in degrees; steps and turns are from a frame to the next.

    Args:
        length: of the whole path.
        extent: the longest side of the box around all cameras.
        step, longest_step: the median and the greatest.
        turn, widest_turn: the same of rotations.
        repeated: frames whose pose is that of an earlier frame.
    """

    length: float
    extent: float
    step: float
    longest_step: float
    turn: float
    widest_turn: float
    repeated: int


@dataclass(frozen=True)
class PointsSeen:
    """Sparse points and the views that should show them.

    Args:
        count: how many there are.
        seen: share that lies in front of two cameras or more and inside their images.
        views: in how many images one lies, in the median.
    """

    count: int
    seen: float
    views: float


def measure_path(cameras: Cameras) -> CameraPath:
    """Of the cameras of all frames, in order."""
    centers = cameras.centers.double()
    rotations = cameras.cam_to_world[:, :3, :3].double()
    steps = (centers[1:] - centers[:-1]).norm(dim=-1)
    # From the chord: an arccosine is not precise for small angles.
    chords = (rotations[1:] - rotations[:-1]).flatten(1).norm(dim=-1)
    turns = torch.rad2deg(2 * torch.arcsin((chords / 8**0.5).clamp(max=1)))
    extent = (centers.amax(0) - centers.amin(0)).max()
    poses = torch.cat((centers / extent.clamp(min=1e-12), rotations.flatten(1)), 1)
    same = torch.cdist(poses, poses, compute_mode="donot_use_mm_for_euclid_dist") < SAME
    return CameraPath(
        length=float(steps.sum()),
        extent=float(extent),
        step=float(steps.median()),
        longest_step=float(steps.max()),
        turn=float(turns.median()),
        widest_turn=float(turns.max()),
        repeated=int(same.tril(-1).any(1).sum()),
    )


def count_points(cameras: Cameras, points: Float[Tensor, "P 3"]) -> PointsSeen:
    """In how many of the images each of the points (float64) lies."""
    views = torch.zeros(len(points), dtype=torch.int64)
    size = torch.tensor([cameras.width, cameras.height])
    poses, lenses = cameras.cam_to_world.double(), cameras.intrinsics.double()
    for pose, lens in zip(poses, lenses, strict=True):
        in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels = in_camera @ lens[:2].T / in_camera[:, 2:]
        views += ((pixels >= 0) & (pixels <= size)).all(-1) & (in_camera[:, 2] > 0)
    return PointsSeen(
        count=len(points),
        seen=float((views >= 2).double().mean()),
        views=float(views.double().median()),
    )
