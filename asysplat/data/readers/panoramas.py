"""Panoramas, equirectangular photographs of all directions, read as faces of a cube around them.

Their axes are COLMAP's and nerfstudio's: z points to the image's center, y to its lower border.
"""

import math
from dataclasses import replace

from asysplat.data.bad_images import BadImages
from asysplat.data.images import PANORAMA, Lens, same_proportions
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

# Degrees to the right. Without the faces above and below: these show sky, and whatever carries the
# camera and moves with it; floor and ceiling there are seen from the side in other panoramas.
YAWS = (0.0, 90.0, 180.0, 270.0)


def panorama(width: int, height: int, where: str) -> Lens:
    """Return the lens of a whole panorama."""
    if not same_proportions((width, height), (2, 1)):
        raise InputError(
            f"{where} is {PANORAMA} and {width} x {height}: give panoramas of all directions, "
            "twice as wide as high."
        )
    fx, fy = width / (2 * math.pi), height / math.pi
    return Lens(width, height, fx, fy, cx=width / 2, cy=height / 2, model=PANORAMA)


def with_faces(scene: PosedScene, bad: BadImages) -> PosedScene:
    """Return a scene with four faces, each 90 degrees wide, in place of every panorama.

    They follow the other images: the first faces of all panoramas, then the second ones, and so on,
    so that consecutive images overlap. Errors of single panoramas are collected.
    """
    plain_images = [image for image in scene.images if image.lens.model != PANORAMA]
    panoramas = ((image,) for image in scene.images if image.lens.model == PANORAMA)
    sides = zip(*bad.read_each(_faces, panoramas), strict=True)
    return replace(scene, images=plain_images + [face for side in sides for face in side])


def _faces(image: PosedImage) -> list[PosedImage]:
    if image.depth is not None:
        raise InputError(
            f"{image.file} is a panorama with a depth map, and depths are along z: leave the "
            "depth map out."
        )
    side = math.ceil(2 * max(image.lens.fx, image.lens.fy))  # pixels as fine as at the equator
    square = replace(image.lens, width=side, height=side, cx=side / 2, cy=side / 2)
    faces = []
    for yaw in YAWS:
        lens, pose = replace(square, yaw=yaw), image.cam_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ lens.rotation
        faces.append(replace(image, lens=lens, cam_to_world=pose))
    return faces
