"""K.txt, poses.txt, images/ and depth/."""

import numpy as np

from layouts import poses, save_depth, save_image


def write(views, folder):
    for index, image in enumerate(views.images):
        save_image(folder / f"images/{index:05d}.png", image)
        if views.depths is not None:
            save_depth(folder / f"depth/{index:05d}.png", views.depths[index])
    np.savetxt(folder / "K.txt", views.cameras.intrinsics[0].double().numpy())
    np.savetxt(folder / "poses.txt", poses(views).reshape(-1, 16))
    return folder
