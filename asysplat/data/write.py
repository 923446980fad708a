"""Write views to disk in nerfstudio's layout: transforms.json beside images/ and depth/."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import Cameras, Views, decode

STEPS_PER_UNIT = 1000  # stored depths of one scene unit
MAX_STEP = 2**16 - 1  # largest depth in a 16-bit image


def write_transforms(views: Views, folder: Path) -> None:
    """Write one scene: transforms.json, images/NNNNN.png, and depth/NNNNN.png where known.

    Depths are 16-bit PNG of thousandths of a scene unit along z, 0 where unknown.
    """
    if views.images.ndim != 4:
        raise InputError(
            f"Views.images has shape {tuple(views.images.shape)}: expected [V, 3, H, W]; write "
            "the scenes of a batch one by one."
        )
    target = folder / "transforms.json"
    if target.exists():
        raise InputError(f"{target} exists: name a new folder, nothing is overwritten.")
    views = views.to("cpu")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    names = [f"{index:05d}.png" for index in range(views.num_views)]
    content = describe_cameras(views.cameras, [f"images/{name}" for name in names])
    if views.depths is not None:
        (folder / "depth").mkdir(exist_ok=True)
        content["depth_unit_scale_factor"] = 1 / STEPS_PER_UNIT
    for index, (name, frame) in enumerate(zip(names, content["frames"], strict=True)):
        write_image(decode(views.images[index]), folder / "images" / name)
        if views.depths is not None:
            frame["depth_file_path"] = f"depth/{name}"
            steps = (views.depths[index].double() * STEPS_PER_UNIT).round().numpy()
            steps = np.where(steps > MAX_STEP, 0, steps).astype(np.uint16)  # beyond it: unknown
            Image.fromarray(steps).save(folder / "depth" / name)
    target.write_text(json.dumps(content, indent=1))


def write_image(image: Float[Tensor, "3 H W"], path: Path) -> None:
    """Write RGB in [0, 1], clamped, with 8 bits a channel."""
    levels = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    Image.fromarray(levels.permute(1, 2, 0).numpy()).save(path)


def describe_cameras(cameras: Cameras, files: Sequence[str]) -> dict[str, Any]:
    """Describe cameras, [V], and their image files as in a transforms.json.

    With OpenGL axes (x right, y up, z backward). Pixels are those of `Cameras`, as in nerfstudio.
    Format: https://docs.nerf.studio/quickstart/data_conventions.html
    """
    frames = []
    poses = cameras.cam_to_world * cameras.cam_to_world.new_tensor([1, -1, -1, 1])
    for file, pose, matrix in zip(files, poses, cameras.intrinsics, strict=True):
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        intrinsics = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        frames.append({"file_path": file, "transform_matrix": pose.tolist(), **intrinsics})
    size = {"w": cameras.width, "h": cameras.height}
    return {"camera_model": "PINHOLE", **size, "frames": frames}


def refuse_inside(folder: Path, data: Path, advice: str) -> None:
    """Check that `folder` is outside of a data set (its folder, or a file in it)."""
    data = (data if data.is_dir() else data.parent).resolve()
    if folder.expanduser().resolve().is_relative_to(data):
        raise InputError(
            f"{folder.absolute()} lies in the data set {data}, which is never changed: {advice}."
        )
