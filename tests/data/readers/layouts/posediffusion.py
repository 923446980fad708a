"""gt_cameras.npz beside the images, with PyTorch3D's axes."""

import numpy as np

from layouts import poses, save_image

HAS_DEPTHS = FREE_INTRINSICS = False


def write(views, folder):
    half = min(views.images.shape[-2:]) / 2
    focals = views.cameras.intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2].numpy() / half
    cameras = {"gtR": [], "gtT": [], "gtFL": focals}
    for index, pose in enumerate(poses(views)):
        save_image(folder / f"frame{index:06d}.png", views.images[index])
        to_camera = np.linalg.inv(pose @ np.diag([-1.0, -1.0, 1.0, 1.0]))
        cameras["gtR"].append(to_camera[:3, :3].T)
        cameras["gtT"].append(to_camera[:3, 3])
    np.savez(folder / "gt_cameras.npz", **{k: np.float32(value) for k, value in cameras.items()})
    return folder
