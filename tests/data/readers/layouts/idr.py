"""cameras_sphere.npz, and image/ of NNNNNN.png."""

import numpy as np

from layouts import poses, save_image

HAS_DEPTHS = False


def write(views, folder):
    cameras = {}
    intrinsics = views.cameras.intrinsics.double().numpy().copy()
    intrinsics[:, :2, 2] -= 0.5
    for index, (pose, matrix) in enumerate(zip(poses(views), intrinsics, strict=True)):
        save_image(folder / f"image/{index:06d}.png", views.images[index])
        projection = np.eye(4)
        projection[:3] = -2 * matrix @ np.linalg.inv(pose)[:3]  # up to a factor
        cameras[f"world_mat_{index}"] = projection
    np.savez(folder / "cameras_sphere.npz", **cameras)
    return folder
