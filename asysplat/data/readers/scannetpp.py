"""Reader of ScanNet++: images of a reflex camera (DSLR), or of an iPhone with its LiDAR.

A scene is named by one of these files of poses; a folder stands for the first that it has:

<scene>/dslr/nerfstudio/transforms_undistorted.json  resized_undistorted_images, .._masks
<scene>/dslr/nerfstudio/transforms.json              fisheye: resized_images, resized_anon_masks,
                                                     and render_depth, from the toolkit
<scene>/iphone/nerfstudio/transforms.json            COLMAP's, some images: rgb, rgb_masks, depth
<scene>/iphone/pose_intrinsic_imu.json               ARKit's, every image: the same folders

Depths are 16-bit PNG, millimeters along z (256 x 192 for the iPhone's 1920 x 1440). Masks are 0
where a pixel was made anonymous. The world is the laser scan's, in meters: the transforms files
turn its axes, and this reader turns them back, so that both cameras, the sparse points and the mesh
agree.

https://kaldir.vc.in.tum.de/scannetpp/documentation
https://github.com/scannetpp/scannetpp (common/scene_release.py, common/utils/nerfstudio.py)
"""

import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers import common
from asysplat.data.readers.transforms import read_images
from asysplat.data.sequence import Points, PosedImage, PosedScene
from asysplat.errors import InputError
from asysplat.files import read_json

EXTRACT = (
    "extract rgb.mkv (or rgb.mp4) with the toolkit's iphone.prepare_iphone_data, or with "
    "ffmpeg -i rgb.mkv -start_number 0 -q:v 1 rgb/frame_%06d.jpg"
)
ARKIT = "iphone/pose_intrinsic_imu.json"
# For each file of poses: its folders of images, masks and depths, or "", and how to get the images.
PARTS = {
    "dslr/nerfstudio/transforms_undistorted.json": (
        *("resized_undistorted_images", "resized_undistorted_masks", ""),
        "download it, or run the toolkit's dslr.undistort",
    ),
    "dslr/nerfstudio/transforms.json": (
        *("resized_images", "resized_anon_masks", "render_depth"),
        "download it",
    ),
    "iphone/nerfstudio/transforms.json": ("rgb", "rgb_masks", "depth", EXTRACT),
    ARKIT: ("rgb", "rgb_masks", "depth", EXTRACT),
}
# From the scan's world to that of the transforms files, and back.
TURN = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])


def find_scenes(root: Path) -> list[Path]:
    """Find the file of poses of each scene's folder, or the named one.

    A scene's folder stands for the first file in the list above whose images exist; <scene>/dslr
    and <scene>/iphone stand for the first of that camera.
    """
    if root.is_file():
        return [root] if _key(root) else []
    if root.name in ("dslr", "iphone"):
        return _first(root.parent, root.name)
    return [file for scene in common.folders_with(root, *PARTS) for file in _first(scene)]


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read one camera's images and COLMAP's points; the name is <scene>-dslr or -iphone.

    Includes the benchmark's test images where they were published. Images that the file marks
    `is_bad` are left out, with a warning.
    """
    files = find_scenes(scene)
    if len(files) != 1:
        raise InputError(
            f"{scene} holds {len(files)} scenes of ScanNet++: name one, or one of its files "
            f"{', '.join(PARTS)}."
        )
    key = _key(files[0])
    folder = files[0].parents[key.count("/") - 1]
    images, masks, depths, how_to_get = PARTS[key]
    if not (folder / images).is_dir():
        raise InputError(f"{folder / images} does not exist: {how_to_get}.")
    read = _arkit if key == ARKIT else _transforms
    return PosedScene(
        name=f"{folder.parent.name}-{folder.name}",
        images=read(files[0], folder, images, masks, depths, bad),
        read_points=partial(_points, folder / "colmap/points3D.txt"),
    )


def _key(file: Path) -> str:
    """Return the path of `file` from its scene's folder on; "" for other files."""
    return next((key for key in PARTS if file.as_posix().endswith(f"/{key}")), "")


def _first(scene: Path, camera: str = "") -> list[Path]:
    """Return the file of poses that the scene stands for; one with images before one without."""
    keys = [key for key in PARTS if key.startswith(camera) and (scene / key).is_file()]
    keys.sort(key=lambda key: not (scene / key.split("/")[0] / PARTS[key][0]).is_dir())
    return [scene / key for key in keys[:1]]


def _transforms(
    file: Path, folder: Path, images: str, masks: str, depths: str, bad: BadImages
) -> list[PosedImage]:
    content = common.read_frames(file)
    downloaded = (folder / masks).is_dir()
    has_masks = content.get("has_mask", downloaded)
    if has_masks and not downloaded:
        raise InputError(f"{folder / masks} does not exist, but {file} has masks: download it.")
    has_depths = depths and (folder / depths).is_dir()
    frames = []
    for entry in _good_frames(content, file, folder / images):
        name = f"{Path(entry['file_path']).stem}.png"
        paths = {
            "file_path": f"{images}/{entry['file_path']}",
            "mask_path": f"{masks}/{name}" if has_masks else None,
            "depth_file_path": f"{depths}/{name}" if has_depths else None,
        }
        frames.append({**entry, **paths})
    posed = read_images({**content, "frames": frames}, file, bad, folder)
    return [replace(image, cam_to_world=TURN @ image.cam_to_world) for image in posed]


def _good_frames(content: dict[str, Any], file: Path, images: Path) -> list[Any]:
    """Return training entries and published test entries that are not marked as bad."""
    test = content.get("test_frames", [])
    if not any((images / entry["file_path"]).is_file() for entry in test):
        test = []  # hidden ones, or the DSLR's in the iPhone's file
    frames = content["frames"] + test
    good = [entry for entry in frames if not entry.get("is_bad")]
    if len(good) < len(frames):
        warnings.warn(
            f"{file}: left out {len(frames) - len(good)} of {len(frames)} images that the data set "
            "marks is_bad.",
            stacklevel=2,
        )
    return good


def _arkit(
    file: Path, folder: Path, images: str, masks: str, depths: str, bad: BadImages
) -> list[PosedImage]:
    """Read ARKit's poses, by image: camera-to-world with OpenCV axes and intrinsics in pixels."""
    content = read_json(file)
    mask_folder, depth_folder = (
        folder / name if (folder / name).is_dir() else None for name in (masks, depths)
    )

    def read(name: str, entry: dict[str, Any]) -> PosedImage:
        where, image = f"{file}, {name}", folder / images / f"{name}.jpg"
        size = image_size(image)
        (fx, _, cx), (_, fy, cy), _ = np.array(entry["intrinsic"], np.float64).tolist()
        return PosedImage(
            file=image,
            lens=common.scale_lens(Lens(*size, fx, fy, cx, cy), size, where),
            cam_to_world=common.check_rigid(entry["aligned_pose"], f"{where}: aligned_pose"),
            depth=depth_folder and common.check_map_size(depth_folder / f"{name}.png", size, where),
            depth_unit=common.MILLIMETERS,
            mask=mask_folder and common.check_map_size(mask_folder / f"{name}.png", size, where),
        )

    return bad.read_each(read, sorted(content.items()))


def _points(file: Path) -> Points | None:
    """Read columns 2 to 4 of COLMAP's points3D.txt, https://colmap.github.io/format.html."""
    if not file.is_file():
        return None
    try:
        return np.loadtxt(file, usecols=(1, 2, 3), ndmin=2)
    except ValueError as error:
        raise InputError(f"{file} cannot be read ({error}): download it again.") from error
