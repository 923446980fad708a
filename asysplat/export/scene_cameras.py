"""The cameras of a file of Gaussians: those beside it, or one before it."""

from pathlib import Path

import torch

from asysplat.data.readers.transforms import read_cameras, read_poses
from asysplat.errors import InputError
from asysplat.scene import Cameras, Gaussians

CAMERAS = "transforms.json"  # beside a file of Gaussians
MIN_IN_VIEW = 0.5  # fraction of the Gaussians that its cameras see, if they are the scene's


def cameras_beside(scene: Path, gaussians: Gaussians) -> Cameras | None:
    """Read the cameras beside a file of Gaussians; None, and a line why, where none fit it."""
    file = scene.with_name(CAMERAS)
    if not file.exists():
        return None
    try:
        cameras = read_cameras(file)
    except (InputError, OSError) as error:
        print(f"without cameras: {error}")
        return None
    seen = torch.zeros(gaussians.num_gaussians, dtype=torch.bool)
    for view in range(cameras.num_views):
        seen |= cameras.select([view]).project(gaussians.means)[2][0]
    if (visible := seen.float().mean().item()) < MIN_IN_VIEW:
        print(f"without cameras: those of {file} have {visible:.0%} of the Gaussians in view.")
        return None
    return cameras


def names_beside(scene: Path) -> list[str]:
    """Return the photographs' names of the cameras beside a file of Gaussians."""
    return [Path(name).name for name, _ in read_poses(scene.with_name(CAMERAS))]


def camera_before(gaussians: Gaussians) -> Cameras:
    """Make a camera that has most Gaussians in view, with y down as COLMAP's worlds often have."""
    center = gaussians.means.median(0).values
    radius = (gaussians.means - center).norm(dim=-1).median()
    pose = torch.eye(4)
    pose[:3, 3] = center - torch.tensor([0.0, 0.0, 3.0]) * radius
    intrinsics = torch.tensor([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    return Cameras(intrinsics[None], pose[None], 1, 1)
