"""Reader of pixelSplat's chunks of RealEstate10K; ACID and DL3DV are found in this form as well.

root/{train,test}/NNNNNN.torch  a list of scenes: dicts of key, url, timestamps, cameras and images
root/{train,test}/index.json    key -> name of its chunk

cameras [V, 18]: fx fy cx cy in image widths and heights, two numbers that are 0, then
world-to-camera as 3x4, row-major, OpenCV axes. images: V uint8 tensors, each the bytes of a JPEG.

https://github.com/dcharatan/pixelsplat#acquiring-datasets
https://google.github.io/realestate10k/download.html
"""

import zipfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from asysplat.data.bad_images import BadImages
from asysplat.data.images import EncodedImage, Lens, image_size
from asysplat.data.readers.common import check_rigid, invert_pose
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError
from asysplat.files import read_json

CHUNK = ".torch"
NUMBERS = 18  # for one camera


def find_scenes(root: Path) -> list[Path]:
    """Find scenes as chunk.torch/key: in a chunk, a folder of chunks, or its train and test."""
    if any(parent.suffix == CHUNK for parent in root.parents):
        return [root]
    if root.suffix == CHUNK:
        return [root / key for key in _load(root)]
    if not root.is_dir():
        return []
    folders = [root, *sorted(child for child in root.iterdir() if child.is_dir())]
    return [scene for folder in folders for scene in _in_folder(folder)]


def read_scene(scene: Path, bad: BadImages) -> PosedScene:
    """Read one scene, named chunk.torch/key; its images stay in the file until they are decoded."""
    chunk = next((parent for parent in scene.parents if parent.suffix == CHUNK), None)
    if chunk is None:
        raise InputError(f"{scene} is no scene in a chunk: name one as 000000{CHUNK}/key.")
    key = scene.relative_to(chunk).as_posix()
    entry = _load(chunk).get(key)
    if entry is None:
        raise InputError(f"{chunk} has no scene {key}: name another chunk.")
    cameras, images = entry.get("cameras"), entry.get("images")
    if not isinstance(cameras, Tensor) or cameras.ndim != 2 or cameras.shape[1] != NUMBERS:
        kind = tuple(cameras.shape) if isinstance(cameras, Tensor) else type(cameras).__name__
        raise InputError(f"{scene}: cameras is {kind}: give a tensor [V, {NUMBERS}].")
    if not isinstance(images, list) or len(images) != len(cameras):
        kind = len(images) if isinstance(images, list) else type(images).__name__
        raise InputError(
            f"{scene} has {len(cameras)} cameras and images is {kind}: give a list of as many."
        )
    cameras = cameras.double().numpy()

    def read(index: int, image: object) -> PosedImage:
        where, camera = f"{scene}, frame {index}", cameras[index]
        if not isinstance(image, Tensor) or image.dtype != torch.uint8 or image.ndim != 1:
            raise InputError(f"{where}: its image is no uint8 tensor [bytes]: give a JPEG's bytes.")
        encoded = EncodedImage(where, image.numpy())
        width, height = image_size(encoded)
        fx, fy, cx, cy, *unused = camera[:6].tolist()
        if not np.isfinite(camera[:6]).all() or min(fx, fy) <= 0:
            raise InputError(
                f"{where}: its intrinsics are {camera[:4].tolist()}: give fx, fy > 0, cx and cy in "
                "widths and heights of the image."
            )
        if any(unused):
            raise InputError(
                f"{where}: numbers 5 and 6 of its camera are {unused}: they must be 0, so "
                "undistort the images."
            )
        world_to_cam = np.vstack((camera[6:].reshape(3, 4), (0, 0, 0, 1)))
        return PosedImage(
            file=encoded,
            lens=Lens(width, height, fx * width, fy * height, cx * width, cy * height),
            cam_to_world=invert_pose(check_rigid(world_to_cam, f"{where}: its world-to-camera")),
        )

    return PosedScene(key, bad.read_each(read, enumerate(images)))


def _in_folder(folder: Path) -> list[Path]:
    chunks = sorted(folder.glob(f"*{CHUNK}"))
    index = folder / "index.json"
    if not chunks or not index.is_file():
        return [chunk / key for chunk in chunks for key in _load(chunk)]
    content = read_json(index)
    if not isinstance(content, dict):
        raise InputError(f"{index} is no object of key: chunk: write it again.")
    names = {chunk.name for chunk in chunks}
    for key, name in content.items():
        if name not in names:
            raise InputError(
                f"{index}: scene {key} is in {name!r}, which does not exist: copy that chunk, or "
                "name single chunks."
            )
    return [folder / name / key for key, name in content.items()]


def _load(chunk: Path) -> dict[str, dict[str, object]]:
    if not chunk.is_file():
        raise InputError(f"{chunk} does not exist: copy it there, or name another chunk.")
    return _load_once(chunk, chunk.stat().st_mtime_ns)


@lru_cache(maxsize=1)  # scenes are mostly opened chunk by chunk
def _load_once(chunk: Path, modified: int) -> dict[str, dict[str, object]]:
    try:
        # Only zip files can be mapped; older versions of torch wrote another format.
        scenes = torch.load(
            chunk, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(chunk)
        )
    # Damaged files make torch raise anything from EOFError to RuntimeError.
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{chunk} cannot be read as tensors alone ({reason}): copy it again; code in it is "
            "never run."
        ) from error
    if not isinstance(scenes, list) or not all(
        isinstance(scene, dict) and isinstance(scene.get("key"), str) for scene in scenes
    ):
        raise InputError(
            f'{chunk} is no list of scenes, each with a "key": give a chunk of pixelSplat\'s form.'
        )
    return {scene["key"]: scene for scene in scenes}
