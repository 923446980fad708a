"""Reader of COLMAP's sparse models, text and binary.

MipNeRF-360, Tanks&Temples and Deep Blending are published in this layout.

https://colmap.github.io/format.html
"""

import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray

from asysplat.data.bad_images import BadImages
from asysplat.data.images import Lens, image_size
from asysplat.data.readers import common
from asysplat.data.readers.additions import panorama
from asysplat.data.readers.colmap_model import read_model
from asysplat.data.sequence import Points, PosedImage, PosedScene
from asysplat.errors import InputError

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
FOLDERS = ("images", "images_undistort", "images_2", "images_4", "images_8", ".")
MAX_NAMES = 5  # in a warning
SAME_WORLD = 1e-3  # greatest difference of rotations, and of positions over the cameras' extent


def find_scenes(root: Path) -> list[Path]:
    """Find folders with a model in `sparse/0`, `sparse`, `colmap/sparse/0` or the folder itself."""
    marks = (f"{model}/cameras.{kind}" for model in MODELS for kind in ("bin", "txt"))
    return common.folders_with(root, *marks)


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read a folder with a model and the images that it names.

    The names are relative to the first of FOLDERS that holds the most of them. Reads the registered
    images, ordered by the numbers in their names (2 before 10); a warning lists images that are not
    registered. Where images are smaller than their cameras' size, the intrinsics are scaled.
    """
    model = _find_model(scene)
    if model is None:
        raise InputError(f"{scene} has no COLMAP model: expected one in {', '.join(MODELS)}.")
    colmap = read_model(model)
    registered = [image for image in colmap.images.values() if image.has_pose]
    registered.sort(key=lambda image: common.natural_order(Path(image.name)))
    folder = _images_folder(scene, model, [image.name for image in registered])
    _warn_of_unregistered(model, [folder / image.name for image in registered])
    cameras = {image.camera_id for image in registered}
    lenses = {key: _lens(colmap.cameras[key], f"{model}, camera {key}") for key in cameras}

    def read(image: pycolmap.Image) -> PosedImage:
        path = folder / image.name
        lens = common.scale_lens(lenses[image.camera_id], image_size(path), str(path))
        return PosedImage(path, lens, _cam_to_world(image, model))

    images = bad.read_each(read, ((image,) for image in registered))
    return PosedScene(scene.name, images, partial(_points, model))


def read_poses(model: Path) -> list[tuple[str, Float[ndarray, "4 4"]]]:
    """Read name and pose of every registered image of a model, whose images may be absent.

    Poses are camera-to-world with OpenCV axes.
    """
    images = read_model(model).images.values()
    return [(image.name, _cam_to_world(image, model)) for image in images if image.has_pose]


def read_model_points(scene: Path, posed: Sequence[PosedImage]) -> Points | None:
    """Read the sparse points of a model beside images whose poses were read elsewhere.

    None if there is no model, or if its poses of the images with the same names differ: then its
    world is another one.
    """
    if (model := _find_model(scene)) is None:
        return None
    colmap = read_model(model)
    images = {Path(image.name).name: image for image in colmap.images.values() if image.has_pose}
    posed = [image for image in posed if image.file.name in images]
    if not posed:
        return None
    poses = np.array([image.cam_to_world for image in posed])
    model_poses = [_cam_to_world(images[image.file.name], model) for image in posed]
    difference, extent = np.abs(poses - model_poses), np.ptp(poses[:, :3, 3], axis=0).max()
    rotation, translation = difference[:, :3, :3].max(), difference[:, :3, 3].max()
    same_world = rotation < SAME_WORLD and translation < SAME_WORLD * extent
    return _points(colmap) if same_world else None


def _find_model(scene: Path) -> Path | None:
    models = (scene / name for name in MODELS)
    kinds = ("cameras.bin", "cameras.txt")
    return next((m for m in models if any((m / kind).is_file() for kind in kinds)), None)


def _cam_to_world(image: pycolmap.Image, model: Path) -> Float[ndarray, "4 4"]:
    pose, cam_from_world = np.eye(4), image.cam_from_world()
    cam_from_world.rotation.normalize()  # as in COLMAP, which keeps what a file has
    pose[:3] = cam_from_world.matrix()
    return common.invert_pose(common.check_rigid(pose, f"{model}, pose of {image.name}"))


def _points(colmap: pycolmap.Reconstruction | Path) -> Points | None:
    model = read_model(colmap) if isinstance(colmap, Path) else colmap
    points = sorted(model.points3D.items())
    return np.array([point.xyz for _, point in points]) if points else None


def _lens(camera: pycolmap.Camera, where: str) -> Lens:
    if camera.is_spherical():
        return panorama(*(round(side) for side in camera.params), where)
    return Lens.from_camera(camera)


def _images_folder(scene: Path, model: Path, names: Sequence[str]) -> Path:
    counts = {
        folder: sum((scene / folder / name).is_file() for name in names) for folder in FOLDERS
    }
    best = max(counts, key=lambda folder: counts[folder])
    if counts[best] == 0:
        named = f"names {len(names)} images, such as {names[0]}" if names else "registers no image"
        raise InputError(
            f"{model} {named}, and {scene} has none of them: give the folder that holds the model "
            f"and one of {', '.join(FOLDERS[:-1])}."
        )
    return scene / best


def _warn_of_unregistered(model: Path, registered: Sequence[Path]) -> None:
    used = set(registered)
    folders = sorted({path.parent for path in registered})
    unregistered = [
        path for folder in folders for path in common.images_in(folder) if path not in used
    ]
    if unregistered:
        names = ", ".join(path.name for path in unregistered[:MAX_NAMES])
        warnings.warn(
            f"{model} has not registered {len(unregistered)} of {len(unregistered) + len(used)} "
            f"images, which are left out: {names}{', ...' * (len(unregistered) > MAX_NAMES)}; "
            "photograph what lies between them and the others to use them, too",
            stacklevel=2,
        )
