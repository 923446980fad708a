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
from typing import Any

import numpy as np
import torch
from torch import Tensor

from asysplat.data.bad_images import BadImages
from asysplat.data.images import EncodedImage, Lens, image_size
from asysplat.data.readers.common import check_rigid, invert_pose, scale_lens
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError, brief
from asysplat.files import read_json

CHUNK = ".torch"


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
    cameras = entry["cameras"].double().numpy()

    def read(index: int, image: Tensor) -> PosedImage:
        stored = image.numpy()
        camera, encoded = cameras[index], EncodedImage(f"{scene}, frame {index}", stored.tobytes)
        width, height = image_size(encoded)
        fx, fy, cx, cy, *unused = camera[:6].tolist()
        if any(unused):
            raise InputError(f"{encoded}: its image is distorted: undistort it.")
        world_to_cam = np.vstack((camera[6:].reshape(3, 4), (0, 0, 0, 1)))
        lens = Lens(width, height, fx * width, fy * height, cx * width, cy * height)
        return PosedImage(
            file=encoded,
            lens=scale_lens(lens, (width, height), str(encoded)),
            cam_to_world=invert_pose(check_rigid(world_to_cam, f"{encoded}: world-to-camera")),
        )

    return PosedScene(
        key, bad.read_each(read, zip(range(len(cameras)), entry["images"], strict=True))
    )


def _in_folder(folder: Path) -> list[Path]:
    chunks = sorted(folder.glob(f"*{CHUNK}"))
    index = folder / "index.json"
    if not chunks or not index.is_file():
        return [chunk / key for chunk in chunks for key in _load(chunk)]
    content = read_json(index)
    names = {chunk.name for chunk in chunks}
    if missing := sorted(set(content.values()) - names):
        raise InputError(f"{index} names {missing[0]}, which does not exist: copy that chunk.")
    return [folder / name / key for key, name in content.items()]


def _load(chunk: Path) -> dict[str, dict[str, Any]]:
    if not chunk.is_file():
        raise InputError(f"{chunk} does not exist: copy it there, or name another chunk.")
    return _load_once(chunk, chunk.stat().st_mtime_ns)


@lru_cache(maxsize=1)  # scenes are mostly opened chunk by chunk
def _load_once(chunk: Path, modified: int) -> dict[str, dict[str, Any]]:
    try:
        # Only zip files can be mapped; older versions of torch wrote another format.
        scenes = torch.load(
            chunk, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(chunk)
        )
    except Exception as error:  # errors of any kind, from EOFError to RuntimeError
        raise InputError(
            f"{chunk} cannot be read as tensors alone ({brief(error)}): copy it again."
        ) from error
    return {scene["key"]: scene for scene in scenes}
