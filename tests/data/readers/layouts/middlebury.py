"""NAME_par.txt beside the images."""

import numpy as np

from layouts import poses, save_image

HAS_DEPTHS = False


def write(views, folder):
    lines = [str(views.num_views)]
    intrinsics = views.cameras.intrinsics.double().numpy().copy()
    intrinsics[:, :2, 2] -= 0.5
    for index, (pose, matrix) in enumerate(zip(poses(views), intrinsics, strict=True)):
        name, world_to_cam = f"temple{index:04d}.png", np.linalg.inv(pose)
        save_image(folder / name, views.images[index])
        numbers = [*matrix.flat, *world_to_cam[:3, :3].flat, *world_to_cam[:3, 3]]
        lines.append(" ".join([name, *map(repr, map(float, numbers))]))
    (folder / "temple_par.txt").write_text("\n".join(lines) + "\n")
    return folder
