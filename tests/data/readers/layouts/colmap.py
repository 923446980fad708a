"""images/ and sparse/0 with the three text files that COLMAP wrote until 3.11.

Every view sees POINTS points of its own.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from layouts import pinholes, poses, save_image

HAS_DEPTHS = False
POINTS = 6


def points_of(views) -> np.ndarray:
    """The points that `write` makes, [V * POINTS, 3]: where pixels of the first rows look."""
    directions = views.cameras.pixel_directions().double()
    in_camera = (directions * views.depths[..., None])[:, :POINTS, 3]
    matrices = views.cameras.cam_to_world.double()
    world = in_camera @ matrices[:, :3, :3].mT + matrices[:, None, :3, 3]
    return world.flatten(0, 1).numpy()


def write(views, folder):
    cameras = ["# Camera list", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    cameras.append(f"# Number of cameras: {views.num_views}")
    images = ["# Image list", "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    points = ["# 3D point list", "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    images.append(f"# Number of images: {views.num_views}, mean observations per image: {POINTS}")
    points.append(f"# Number of points: {views.num_views * POINTS}, mean track length: 1")
    size = (views.cameras.width, views.cameras.height)
    for index, (pose, numbers) in enumerate(zip(poses(views), pinholes(views), strict=True)):
        name = f"{index}.png"
        save_image(folder / "images" / name, views.images[index])
        world_to_cam = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(world_to_cam[:3, :3]).as_quat()
        turned_and_moved = (w, x, y, z, *world_to_cam[:3, 3])
        cameras.append(_line(index + 1, "PINHOLE", *size, *numbers))
        images.append(_line(index + 1, *turned_and_moved, index + 1, name))
        first = 1 + index * POINTS
        seen = [(3.5, row + 0.5, first + row) for row in range(POINTS)]
        images.append(_line(*(value for point in seen for value in point)))
    for index, point in enumerate(points_of(views)):
        image, row = divmod(index, POINTS)
        points.append(_line(index + 1, *point, 200, 100, 50, 0.5, image + 1, row))
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (model / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def _line(*values) -> str:
    return " ".join(str(value) for value in values)
