"""A list file beside a scene's folder with opencv_cameras.json and images_undistort/."""

import json

import numpy as np

from layouts import pinholes, poses, save_image

HAS_DEPTHS = False


def write(views, folder):
    scene = folder / "desk"
    frames = []
    for index, (pose, numbers) in enumerate(zip(poses(views), pinholes(views), strict=True)):
        name = f"images_undistort/frame{10 * index}.png"  # not padded: 100 sorts before 20
        save_image(scene / name, views.images[index])
        intrinsics = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
        size = {"w": views.cameras.width, "h": views.cameras.height}
        w2c = np.linalg.inv(pose).tolist()
        frames.append({"file_path": name, "w2c": w2c, **size, **intrinsics})
    content = {"scene_name": "desk", "frames": frames}
    (scene / "opencv_cameras.json").write_text(json.dumps(content, indent=1))
    listed = folder / "desks.txt"
    listed.write_text("desk/opencv_cameras.json\n\n")
    return listed
