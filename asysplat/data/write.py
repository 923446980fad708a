"""Write views to disk in nerfstudio's layout: transforms.json beside images/ and depth/."""

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from asysplat.errors import InputError
from asysplat.scene import Views

STEPS_PER_UNIT = 1000  # stored depths of one scene unit
MAX_STEP = 2**16 - 1  # largest depth in a 16-bit image


def write_transforms(views: Views, folder: Path) -> None:
    """Write one scene: transforms.json, images/NNNNN.png, and depth/NNNNN.png where known.

    Matrices are camera-to-world with OpenGL axes (x right, y up, z backward). cx and cy are in
    pixels with the first pixel's center at +0.5, as in `Cameras`. Depths are 16-bit PNG of
    thousandths of a scene unit along the camera's z axis, 0 where unknown. Format:
    https://docs.nerf.studio/quickstart/data_conventions.html

    Raises:
        InputError: views with a batch dimension, or a folder that contains a transforms.json.
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
    top = {"camera_model": "PINHOLE", "w": views.cameras.width, "h": views.cameras.height}
    if views.depths is not None:
        (folder / "depth").mkdir(exist_ok=True)
        top["depth_unit_scale_factor"] = 1 / STEPS_PER_UNIT
    frames = []
    poses = views.cameras.cam_to_world * torch.tensor([1.0, -1.0, -1.0, 1.0])
    for index, (pose, matrix) in enumerate(zip(poses, views.cameras.intrinsics, strict=True)):
        name = f"{index:05d}.png"
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        frame = {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
        levels = (views.images[index].clamp(0, 1) * 255).round().to(torch.uint8)
        Image.fromarray(levels.permute(1, 2, 0).numpy()).save(folder / "images" / name)
        if views.depths is not None:
            frame["depth_file_path"] = f"depth/{name}"
            steps = (views.depths[index].double() * STEPS_PER_UNIT).round().numpy()
            steps = np.where(steps > MAX_STEP, 0, steps).astype(np.uint16)  # beyond it: unknown
            Image.fromarray(steps).save(folder / "depth" / name)
        frames.append(frame | {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy})
    target.write_text(json.dumps(top | {"frames": frames}, indent=1))


def refuse_inside(folder: Path, data: Path, advice: str) -> None:
    """Check that `folder` is outside of a data set (its folder, or a file in it).

    Raises:
        InputError: it is inside; ends with `advice`.
    """
    data = (data if data.is_dir() else data.parent).resolve()
    if folder.expanduser().resolve().is_relative_to(data):
        raise InputError(
            f"{folder.absolute()} lies in the data set {data}, which is never changed: {advice}."
        )
