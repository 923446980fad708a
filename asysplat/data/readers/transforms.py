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
        folder: what its paths are relative to; None: the file's own folder.
        resized: whether images may have another size than w x h, to which the intrinsics belong.
    """
    folder = folder or file.parent
    held_out = {*content.get("test_filenames", content.get("val_filenames", ()))}
    shared: list[tuple[Path, tuple[int, int]]] = []  # images without w and h of their own

    def read(index: int, entry: Any) -> PosedImage:
        where = common.frame_label(file, index, entry)
        image = _find_image(folder, folder / entry["file_path"])
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
        if "K" in fields:
            (fx, _, cx), (_, fy, cy), *_ = fields["K"]
            fields = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy} | fields
        pose = common.check_rigid(fields.get("transform_matrix"), f"{where}: transform_matrix")

        def optional_map(key: str) -> Path | None:
            """Return the depth map or mask under `key`; None where there is none."""
            if (name := fields.get(key)) is None:
                return None
            return common.check_map_size(folder / name, size, f"{where}: {key}")

        return PosedImage(
            file=image,
            lens=_lens(fields, size, resized, where),
            cam_to_world=common.opencv_from_opengl(pose),
            depth=optional_map("depth_file_path"),
            depth_unit=float(fields.get("depth_unit_scale_factor", common.MILLIMETERS)),
            mask=optional_map("mask_path"),
            held_out=entry["file_path"] in held_out,
        )

    images = bad.read_each(read, enumerate(content["frames"]))
    if all(re.search(r"\d", Path(str(image.file)).stem) for image in images):
        images.sort(key=lambda image: common.natural_order(Path(str(image.file))))
    return images


def _find_image(folder: Path, named: Path) -> Path:
    """Return the image of a path, which may lack its suffix, or be of another machine.

    It is then in the folder of the same name, or in `folder`, perhaps saved in another format.
    """
    places = (named.parent, folder / named.parent.name, folder)
    names = [named.name, *(f"{named.name}{suffix}" for suffix in common.SUFFIXES)]
    names += [f"{named.stem}{suffix}" for suffix in common.SUFFIXES]
    paths = (place / name for place in places for name in names)
    return next((path for path in paths if path.is_file()), named)


def read_poses(file: Path) -> list[tuple[str, Float[ndarray, "4 4"]]]:
    """Read file_path and pose of every entry of a `transforms.json`, whose images may be absent.

    Poses are camera-to-world with OpenCV axes.
    """
    with common.file_errors(file):
        frames = common.read_frames(file)["frames"]
        return [
            (
                entry["file_path"],
                common.opencv_from_opengl(
                    common.check_rigid(entry["transform_matrix"], f"{file}, frame {index}")
                ),
            )
            for index, entry in enumerate(frames)
        ]


def read_cameras(file: Path) -> Cameras:
    """Read the cameras of a `transforms.json`, whose images may be absent, without distortion."""
    poses = [pose for _, pose in read_poses(file)]
    with common.file_errors(file):
        content = common.read_frames(file)
        fields = [{**content, **entry} for entry in content["frames"]]
        width, height = round(fields[0]["w"]), round(fields[0]["h"])
        lenses = [_lens(each, (width, height), True, str(file)) for each in fields]
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
    width, height = round(sized["w"]), round(sized["h"])
    if model == PANORAMA:
        return common.scale_lens(panorama(width, height, where), size, where)
    if model in (*PERSPECTIVE_MODELS, "OPENCV"):
        # The formats disagree about what k4 means for them.
        if fields.get("k4"):
            raise InputError(
                f"{where}: k4 is only known for OPENCV_FISHEYE, FULL_OPENCV and "
                "THIN_PRISM_FISHEYE: name one of them as camera_model, or undistort the images."
            )
        model = "FULL_OPENCV" if fields.get("k3") else "OPENCV"
    names = DISTORTIONS[model].split()
    lens = Lens(
        width,
        height,
        *_focal(fields, width, height, where),
        cx=float(fields.get("cx", width / 2)),
        cy=float(fields.get("cy", height / 2)),
        model=model,
        distortion=tuple(float(fields.get(name, 0.0)) for name in names),
    )
    return common.scale_lens(lens, size, where)


def _focal(fields: dict[str, Any], width: int, height: int, where: str) -> tuple[float, float]:
    """Return fx and fy in pixels, from focal lengths or fields of view; one may give both."""
    focal = {}
    for axis, pixels in (("x", width), ("y", height)):
        if f"fl_{axis}" in fields:
            focal[axis] = float(fields[f"fl_{axis}"])
        elif f"camera_angle_{axis}" in fields:
            focal[axis] = 0.5 * pixels / math.tan(0.5 * fields[f"camera_angle_{axis}"])
    if not focal:
        raise InputError(f"{where} has no intrinsics: give fl_x in pixels, or camera_angle_x.")
    fx = focal["x"] if "x" in focal else focal["y"]
    return fx, focal.get("y", fx)
