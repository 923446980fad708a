"""Reader of `transforms.json`, the format of instant-ngp and nerfstudio.

https://github.com/NVlabs/instant-ngp/blob/master/docs/nerf_dataset_tips.md
https://docs.nerf.studio/quickstart/data_conventions.html
"""

import math
import re
from functools import partial
from pathlib import Path
from typing import Any

from asysplat.data.bad_images import BadFrames
from asysplat.data.images import Lens, image_size
from asysplat.data.readers.colmap import points_beside
from asysplat.data.readers.common import (
    MILLIMETERS,
    beside,
    folders_with,
    natural_order,
    number,
    opencv_from_opengl,
    read_json,
    rigid,
    scaled,
)
from asysplat.data.sequence import Photograph, PosedScene
from asysplat.errors import InputError

PERSPECTIVE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a `transforms.json`; `root` may be the json file itself."""
    return [root] if root.suffix == ".json" else folders_with(root, "transforms.json")


def read_scene(scene: Path, bad: BadFrames) -> PosedScene:
    """Read a folder with a `transforms.json`, or the json file itself.

    Of the images, only the headers are read. Frames are ordered by the numbers in their names (2
    before 10), or, if a name has no number, as in the file. Paths in the file are relative to its
    folder.

    Raises:
        InputError: anything in the file that cannot be used.
    """
    file = scene if scene.suffix == ".json" else scene / "transforms.json"
    photographs = read_photographs(read_frames(file), file, bad)
    read_points = partial(points_beside, file.parent, photographs)
    return PosedScene(file.parent.name, photographs, read_points)


def read_frames(file: Path) -> dict[str, Any]:
    """Read the file's content, which has a list "frames".

    Raises:
        InputError: it has none.
    """
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f'{file} has no list "frames": give one entry an image.')
    return content


def read_photographs(
    content: dict[str, Any],
    file: Path,
    bad: BadFrames,
    folder: Path | None = None,
    resized: bool = False,
) -> list[Photograph]:
    """Return the photographs of a `transforms.json`, or of a layout that uses its fields.

    Args:
        content: the file's, with a list "frames".
        file: where it was read, for messages.
        bad: notes the frames that cannot be used.
        folder: what its paths are relative to; None: the file's own folder.
        resized: whether the images may have another size than w x h, to which the intrinsics
            belong.
    """
    folder = folder or file.parent
    photographs = []
    shared = None  # the first image that does not state its own size: the others must match it
    for index, entry in enumerate(content["frames"]):
        with bad.caught():
            if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
                raise InputError(f"{file}, frame {index} has no file_path: name its image.")
            where = f"{file}, frame {index} ({entry['file_path']})"
            image = _find_image(folder / entry["file_path"])
            size = image_size(image)
            if not ("w" in entry and "h" in entry):
                shared = shared or (image, size)
                _check_equal_size(image, size, *shared)
            settings = {**content, **entry}
            photographs.append(_photograph(settings, image, size, folder, resized, where))
    if all(re.search(r"\d", photograph.image.stem) for photograph in photographs):
        photographs.sort(key=lambda photograph: natural_order(photograph.image))
    return photographs


def _photograph(
    settings: dict[str, Any],
    image: Path,
    size: tuple[int, int],
    folder: Path,
    resized: bool,
    where: str,
) -> Photograph:
    return Photograph(
        image=image,
        lens=_lens(settings, size, resized, where),
        cam_to_world=opencv_from_opengl(
            rigid(settings.get("transform_matrix"), f"{where}: transform_matrix")
        ),
        depth=_beside(folder, settings, "depth_file_path", size, where),
        depth_unit=number(settings, "depth_unit_scale_factor", where, default=MILLIMETERS),
        mask=_beside(folder, settings, "mask_path", size, where),
    )


def _lens(settings: dict[str, Any], size: tuple[int, int], resized: bool, where: str) -> Lens:
    """Return the lens of an image of (width, height) `size`."""
    stated = (settings.get("w", size[0]), settings.get("h", size[1]))
    if stated == size:
        return _stated_lens(settings, *size, where)
    if not resized:
        raise InputError(
            f"{where}: w x h is {stated[0]} x {stated[1]}, but the image is {size[0]} x {size[1]}: "
            "give intrinsics for the images' own resolution."
        )
    width, height = (round(number(settings, key, where)) for key in ("w", "h"))
    return scaled(_stated_lens(settings, width, height, where), size, where)


def _stated_lens(settings: dict[str, Any], width: int, height: int, where: str) -> Lens:
    model = settings.get("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or bool(settings.get("is_fisheye", False))
    if not fisheye and model not in PERSPECTIVE_MODELS:
        raise InputError(
            f"{where}: camera_model is {model!r}: undistort the images to PINHOLE, or use one of "
            f"{', '.join(PERSPECTIVE_MODELS)}, OPENCV_FISHEYE."
        )
    # The formats disagree about what k4 means for perspective cameras.
    if not fisheye and number(settings, "k4", where, default=0.0) != 0:
        raise InputError(f"{where}: k4 is only known for OPENCV_FISHEYE: undistort the images.")
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    fx, fy = _focal(settings, width, height, where)
    return Lens(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=number(settings, "cx", where, default=width / 2),
        cy=number(settings, "cy", where, default=height / 2),
        distortion=tuple(number(settings, name, where, default=0.0) for name in names),
        fisheye=fisheye,
    )


def _focal(settings: dict[str, Any], width: int, height: int, where: str) -> tuple[float, float]:
    """Return fx and fy in pixels, from focal lengths or fields of view; one stands for both."""
    found = {}
    for axis, pixels in (("x", width), ("y", height)):
        if f"fl_{axis}" in settings:
            found[axis] = number(settings, f"fl_{axis}", where)
        elif f"camera_angle_{axis}" in settings:
            angle = number(settings, f"camera_angle_{axis}", where)
            found[axis] = 0.5 * pixels / math.tan(0.5 * angle) if 0 < angle < math.pi else 0.0
    if not found:
        raise InputError(f"{where} has no intrinsics: give fl_x in pixels, or camera_angle_x.")
    fx = found.get("x", found.get("y"))
    fy = found.get("y", fx)
    if fx <= 0 or fy <= 0:
        raise InputError(
            f"{where}: fl_x or fl_y (or camera_angle_x, camera_angle_y) is out of range: "
            "give lengths > 0 in pixels, or angles between 0 and pi."
        )
    return fx, fy


def _find_image(path: Path) -> Path:
    """Return `path`, or the image it means if the extension was left out."""
    if path.is_file():
        return path
    candidates = (path.with_name(path.name + suffix) for suffix in (".png", ".jpg"))
    return next((candidate for candidate in candidates if candidate.is_file()), path)


def _beside(
    folder: Path, settings: dict[str, Any], key: str, size: tuple[int, int], where: str
) -> Path | None:
    """Return the depth map or mask that `key` names; None where there is none."""
    name = settings.get(key)
    if name is None:
        return None
    if not isinstance(name, str):
        raise InputError(f"{where}: {key} is {name!r}: give a file name, or leave it out.")
    return beside(folder / name, size, f"{where}: {key}")


def _check_equal_size(
    image: Path, size: tuple[int, int], first: Path, first_size: tuple[int, int]
) -> None:
    if size != first_size:
        raise InputError(
            f"{first} is {first_size[0]} x {first_size[1]} and {image} is {size[0]} x {size[1]}: "
            "give images of one size, or w, h and intrinsics in every frame."
        )
