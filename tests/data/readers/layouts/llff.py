"""poses_bounds.npy for photographs that are eight times as large as those in images_8/."""

import numpy as np

from layouts import pinholes, poses, save_image

HAS_DEPTHS = False
FREE_INTRINSICS = False
FACTOR = 8


def write(views, folder):
    rows = []
    size = FACTOR * np.array([views.cameras.height, views.cameras.width])
    for index, (pose, numbers) in enumerate(zip(poses(views), pinholes(views), strict=True)):
        save_image(folder / f"images_8/image{index:03d}.png", views.images[index])
        right, down, forward, center = pose[:3].T
        size_and_focal = (*size, FACTOR * numbers[0])
        matrix = np.stack((down, right, -forward, center, size_and_focal), axis=1)
        rows.append((*matrix.ravel(), 0.1, 10.0))
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder
