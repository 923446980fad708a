"""The camera path of a reconstruction's video."""

import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from asysplat.errors import InputError
from asysplat.export import orbit, smoothed_path
from asysplat.refinement.photographs import Photographs
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

CAMERA_PATHS = ("own", "orbit", "none")


def check_video(video: DictConfig) -> None:
    """Check the camera path.

    Raises:
        InputError: an unknown one.
    """
    if video.path not in CAMERA_PATHS:
        raise InputError(f"video.path={video.path}: choose {', '.join(CAMERA_PATHS[:-1])} or none.")


def video_cameras(video: DictConfig, photographs: Photographs, gaussians: Gaussians) -> Cameras:
    """Build the cameras of all frames, of the configured path and height.

    Both sides are even, as H.264 needs, unless they are those of the photographs.
    """
    frames = max(1, round(video.seconds * video.fps))
    cameras = photographs.inputs.cameras
    if video.path == "orbit":
        path = orbit(cameras, frames, subject(gaussians, cameras))
    else:
        path = smoothed_path(cameras, frames)
    if video.height is None:
        return path
    width = video.height * path.width / path.height
    return path.resized(*(max(2, 2 * round(side / 2)) for side in (video.height, width)))


@torch.no_grad()
def subject(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "3"]:
    """Compute the median of the surface points at the centers of the views of one scene [V]."""
    rows, columns = cameras.height // 3, cameras.width // 3
    points = []
    for view in range(cameras.num_views):
        camera = cameras.select([view])
        depths = render(gaussians, camera).depth.flatten(0, -3)[0]
        depth = depths[rows : 2 * rows + 1, columns : 2 * columns + 1].median()
        points.append(camera.centers[0] + depth * camera.cam_to_world[0, :3, 2])
    return torch.stack(points).median(0).values
