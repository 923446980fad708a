"""NICE-SLAM's Replica: cam_params.json above a room's traj.txt and results/."""

import json

import numpy as np

from layouts import MILLIMETERS, pinholes, poses, save_depth, save_image


def write(views, folder, steps=MILLIMETERS):
    """With `steps` a meter for depths; the published files have 6553.5."""
    room = folder / "room0"
    for index, image in enumerate(views.images):
        save_image(room / f"results/frame{index:06d}.jpg", image)
        if views.depths is not None:
            save_depth(room / f"results/depth{index:06d}.png", views.depths[index], steps)
    np.savetxt(room / "traj.txt", poses(views).reshape(-1, 16))
    fx, fy, cx, cy = pinholes(views)[0]
    camera = {
        **{"w": views.cameras.width, "h": views.cameras.height},
        # The first pixel's center is at 0 here.
        **{"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5, "scale": steps},
    }
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}, indent=4))
    return folder
