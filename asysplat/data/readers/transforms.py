"""Reader of `transforms.json`, the format of instant-ngp and nerfstudio.

https://github.com/NVlabs/instant-ngp/blob/master/docs/nerf_dataset_tips.md
https://docs.nerf.studio/quickstart/data_conventions.html
"""

import math
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from asysplat.data.bad_images import BadImages
from asysplat.data.images import PANORAMA, Lens, image_size
from asysplat.data.readers import common
from asysplat.data.readers.additions import panorama
from asysplat.data.readers.colmap import read_model_points
from asysplat.data.readers.common import number
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError
from asysplat.scene import Cameras

PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")  # read as OPENCV
DISTORTIONS = {  # names of the parameters of the others, in COLMAP's order
    "OPENCV": "k1 k2 p1 p2",
    "FULL_OPENCV": "k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "k1 k2 k3 k4",
    "THIN_PRISM_FISHEYE": "k1 k2 p1 p2 k3 k4 sx1 sy1",
}


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `transforms.json`; `root` may be the json file itself."""
    return [root] if root.suffix == ".json" else common.folders_with(root, "transforms.json")


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder with a `transforms.json`, or the json file itself.

    Reads only the headers of images. Images are ordered by the numbers in their names (2 before
    10), or, if a name has no number, as in the file. Paths are relative to the file's folder.
    """
    file = scene if scene.suffix == ".json" else scene / "transforms.json"
    images = read_images(common.read_frames(file), file, bad)
    return PosedScene(file.parent.name, images, partial(read_model_points, file.parent, images))


def read_images(
    content: dict[str, Any],
    file: Path,
    bad: BadImages,
    folder: Path | None = None,
    resized: bool = False,
) -> list[PosedImage]:
    """Return the images of a `transforms.json`, or of a layout that uses its fields.

    Args:
        content: the file's, with a list "frames".
        file: where it was read, for messages.
        bad: collects the errors of images that cannot be used.
        folder: what its paths are relative to; None: the file's own folder.
        resized: whether images may have another size than w x h, to which the intrinsics belong.
    """
    folder = folder or file.parent
    shared: list[tuple[Path, tuple[int, int]]] = []  # images without w and h of their own

    def read(index: int, entry: Any) -> PosedImage:
        where = common.frame_label(file, index, entry)
        image = folder / entry["file_path"]
        if not image.name:
            raise InputError(f"{where} has the file_path {image}: name its image.")
        # The path may lack the file's extension.
        paths = [image.with_name(image.name + suffix) for suffix in ("", ".png", ".jpg")]
        image = next((path for path in paths if path.is_file()), image)
        size = image_size(image)
        if not ("w" in entry and "h" in entry):
            shared.append((image, size))
            first, (width, height) = shared[0]
            if size != (width, height):
                raise InputError(
                    f"{first} is {width} x {height} and {image} is {size[0]} x {size[1]}: give "
                    "images of one size, or w, h and intrinsics for every image."
                )
        fields = {**content, **entry}
        pose = common.check_rigid(fields.get("transform_matrix"), f"{where}: transform_matrix")

        def optional_map(key: str) -> Path | None:
            """Return the depth map or mask under `key`; None where there is none."""
            name = fields.get(key)
            if not isinstance(name, str | None):
                raise InputError(f"{where}: {key} is {name!r}: give a file name, or leave it out.")
            if name is None:
                return None
            return common.check_map_size(folder / name, size, f"{where}: {key}")

        unit = number(fields, "depth_unit_scale_factor", where, default=common.MILLIMETERS)
        return PosedImage(
            file=image,
            lens=_lens(fields, size, resized, where),
            cam_to_world=common.opencv_from_opengl(pose),
            depth=optional_map("depth_file_path"),
            depth_unit=unit,
            mask=optional_map("mask_path"),
        )

    images = bad.read_each(read, enumerate(content["frames"]))
    if all(re.search(r"\d", Path(str(image.file)).stem) for image in images):
        images.sort(key=lambda image: common.natural_order(Path(str(image.file))))
    return images


def read_poses(file: Path) -> list[tuple[str, Float[ndarray, "4 4"]]]:
    """Read file_path and pose of every entry of a `transforms.json`, whose images may be absent.

    Poses are camera-to-world with OpenCV axes.
    """
    poses = []
    for index, entry in enumerate(common.read_frames(file)["frames"]):
        where = common.frame_label(file, index, entry)
        pose = common.check_rigid(entry.get("transform_matrix"), f"{where}: transform_matrix")
        poses.append((entry["file_path"], common.opencv_from_opengl(pose)))
    return poses


def read_cameras(file: Path) -> Cameras:
    """Read the cameras of a `transforms.json`, whose images may be absent, without distortion."""
    content, poses = common.read_frames(file), [pose for _, pose in read_poses(file)]
    if not poses:
        raise InputError(f"{file} has no frames: give at least one.")
    frames = content["frames"]
    first, where = {**content, **frames[0]}, common.frame_label(file, 0, frames[0])
    width, height = (round(number(first, side, where)) for side in ("w", "h"))
    lenses = [
        _lens({**content, **entry}, (width, height), True, common.frame_label(file, index, entry))
        for index, entry in enumerate(frames)
    ]
    matrices = [[[o.fx, 0, o.cx], [0, o.fy, o.cy], [0, 0, 1]] for o in lenses]
    intrinsics, poses = torch.tensor(matrices), torch.tensor(np.stack(poses)).float()
    return Cameras(intrinsics, poses, height, width).validate(str(file))


def _lens(fields: dict[str, Any], size: tuple[int, int], resized: bool, where: str) -> Lens:
    """Return the lens of an image of (width, height) `size`."""
    sized = {"w": size[0], "h": size[1], **fields}
    if (sized["w"], sized["h"]) != size and not resized:
        common.refuse_turned(size, (sized["w"], sized["h"]))
        raise InputError(
            f"{where}: w x h is {sized['w']} x {sized['h']}, but the image is {size[0]} x "
            f"{size[1]}: give intrinsics for the images' own resolution."
        )
    model = "OPENCV_FISHEYE" if fields.get("is_fisheye") else fields.get("camera_model", "OPENCV")
    known = (*PERSPECTIVE_MODELS, *DISTORTIONS, PANORAMA)
    if model not in known:
        raise InputError(
            f"{where}: camera_model is {model!r}: undistort the images to PINHOLE, or use one of "
            f"{', '.join(known)}."
        )
    width, height = (round(number(sized, key, where)) for key in ("w", "h"))
    if model == PANORAMA:
        return common.scale_lens(panorama(width, height, where), size, where)
    if model in (*PERSPECTIVE_MODELS, "OPENCV"):
        # The formats disagree about what k4 means for them.
        if number(fields, "k4", where, default=0.0) != 0:
            raise InputError(
                f"{where}: k4 is only known for OPENCV_FISHEYE, FULL_OPENCV and "
                "THIN_PRISM_FISHEYE: name one of them as camera_model, or undistort the images."
            )
        model = "FULL_OPENCV" if number(fields, "k3", where, default=0.0) else "OPENCV"
    names = DISTORTIONS[model].split()
    lens = Lens(
        width,
        height,
        *_focal(fields, width, height, where),
        cx=number(fields, "cx", where, default=width / 2),
        cy=number(fields, "cy", where, default=height / 2),
        model=model,
        distortion=tuple(number(fields, name, where, default=0.0) for name in names),
    )
    return common.scale_lens(lens, size, where)


def _focal(fields: dict[str, Any], width: int, height: int, where: str) -> tuple[float, float]:
    """Return fx and fy in pixels, from focal lengths or fields of view; one may give both."""
    focal = {}
    for axis, pixels in (("x", width), ("y", height)):
        if f"fl_{axis}" in fields:
            focal[axis] = number(fields, f"fl_{axis}", where)
        elif f"camera_angle_{axis}" in fields:
            angle = number(fields, f"camera_angle_{axis}", where)
            focal[axis] = 0.5 * pixels / math.tan(0.5 * angle) if 0 < angle < math.pi else 0.0
    if not focal:
        raise InputError(f"{where} has no intrinsics: give fl_x in pixels, or camera_angle_x.")
    fx = focal["x"] if "x" in focal else focal["y"]
    fy = focal.get("y", fx)
    if fx <= 0 or fy <= 0:
        raise InputError(
            f"{where}: fl_x or fl_y (or camera_angle_x, camera_angle_y) is out of range: "
            "give lengths > 0 in pixels, or angles between 0 and pi."
        )
    return fx, fy
