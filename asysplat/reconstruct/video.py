"""The camera path of a reconstruction's video."""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from omegaconf import DictConfig, ListConfig
from pydantic import Field
from torch import Tensor

from asysplat.data.photographs import Photographs
from asysplat.errors import InputError
from asysplat.export import orbit, smoothed_path
from asysplat.ranges import Positive, check_options
from asysplat.refinement import AnchorScene
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views

MAX_HEIGHT = 4320  # pixels of 8K, the most that decoders of H.264 take
CameraPath = Literal["own", "orbit", "none"]


def check_video(video: DictConfig) -> None:
    """Check the options of a video, except for the names of photographs, see `find_views`."""
    listed = isinstance(video.path, ListConfig)
    ranges = {
        "video.path": Annotated[list[str], Field(min_length=1)] if listed else CameraPath,
        "video.height": Annotated[int, Field(ge=2, le=MAX_HEIGHT)] | None,
        "video.seconds": Positive,
        "video.fps": Positive,
    }
    check_options({f"video.{name}": value for name, value in video.items()}, ranges)


def find_views(video: DictConfig, inputs: Sequence[str], held_out: Sequence[str]) -> list[int]:
    """Find the views that the camera path passes, in its order, by the ends of their paths."""
    if isinstance(video.path, str):
        return list(range(len(inputs)))
    return [_find_view(name, [*inputs, *held_out]) for name in video.path]


def _find_view(name: str, files: Sequence[str]) -> int:
    parts = Path(name).parts
    matches = [view for view, file in enumerate(files) if Path(file).parts[-len(parts) :] == parts]
    if len(matches) == 1:
        return matches[0]
    like = get_close_matches(name, sorted({Path(file).name for file in files}), cutoff=0)
    like = [files[view] for view in matches[:3]] or like
    raise InputError(
        f"video.path: {name} is the name of {len(matches) or 'none'} of the {len(files)} "
        f"photographs used (views=): name one of them, such as {', '.join(like)}."
    )


def video_cameras(
    video: DictConfig, photographs: Photographs, scene: Gaussians | AnchorScene
) -> Cameras:
    """Build the cameras of all frames, of the configured path and height; an orbit needs Gaussians.

    Both sides are even, as H.264 needs, unless they are those of the photographs.
    """
    frames = max(1, round(video.seconds * video.fps))
    cameras = photographs.cameras.select(
        find_views(video, photographs.input_files, photographs.held_out_files)
    )
    if video.path == "orbit" and isinstance(scene, Gaussians):
        focus = object_center(scene, photographs.inputs)
        focus = subject(scene, cameras) if focus is None else focus
        path = orbit(cameras, frames, focus, scene)
    else:
        path = smoothed_path(cameras, frames, as_given=video.path != "own")
    if video.height is None:
        return path
    width = video.height * path.width / path.height
    return path.resized(*(max(2, 2 * round(side / 2)) for side in (video.height, width)))


def object_center(gaussians: Gaussians, inputs: Views) -> Float[Tensor, "3"] | None:
    """Compute the median of the means of an object; None if the inputs show a place."""
    return None if inputs.alphas is None else gaussians.means.median(0).values


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
