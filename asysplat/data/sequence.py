"""Posed photographs of one place: the interface that all of them follow, and those on disk."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from asysplat.data.bad_images import BadFrames
from asysplat.data.cache import ImageCache
from asysplat.data.images import (
    ImageFile,
    Lens,
    content_hash,
    load_depth,
    load_mask,
    load_photograph,
    resize_and_crop,
    resized_intrinsics,
    same_proportions,
    undistort,
)
from asysplat.errors import InputError
from asysplat.scene import Cameras, Views

Points = Float[ndarray, "P 3"]


@runtime_checkable
class ImageSequence(Protocol):
    """An ordered walk through one static place: cameras at hand, images read when asked for.

    File readers and `ProceduralScene` both follow it, so view selection and training need not know
    where the images come from.
    """

    @property
    def name(self) -> str:
        """The name, unique within the data set."""
        ...

    @property
    def num_frames(self) -> int:
        """The number of frames; they are in the order they were taken."""
        ...

    @property
    def cameras(self) -> Cameras:
        """The cameras of all frames, [num_frames, ...]."""
        ...

    def views(self, frames: Sequence[int]) -> Views:
        """Return the named frames in the given order: images in [0, 1], depths where known."""
        ...


@dataclass(frozen=True)
class Photograph:
    """One image file, how it was taken, and what lies beside it.

    Args:
        cam_to_world: rigid, OpenCV axes.
        depth: one-channel integer image of distances along z, `depth_unit` scene units each.
        mask: image that is not 0 where the pixel counts.
        disparity: one-channel integer image of inverse depths, up to a scale and a shift; 0 where
            unknown.
    """

    image: ImageFile
    lens: Lens
    cam_to_world: Float[ndarray, "4 4"]
    depth: ImageFile | None = None
    depth_unit: float = 1.0
    mask: ImageFile | None = None
    disparity: ImageFile | None = None


@dataclass(frozen=True)
class PosedScene:
    """What a reader finds in a scene's files.

    Args:
        name: unique within the data set.
        photographs: in the order they were taken.
        read_points: reads sparse points of the scene's surfaces; None where the files have none.
    """

    name: str
    photographs: list[Photograph]
    read_points: Callable[[], Points | None] | None = None

    @cached_property
    def points(self) -> Points | None:
        """Sparse points, read when first asked for: they may take longer than all the rest."""
        return self.read_points() if self.read_points else None


class FileSequence:
    """Photographs in the order they were taken, as a `ImageSequence`.

    Pixels are read when `views` asks for them: undistorted, resized until the shorter side fits,
    and cropped to the center. If any photograph has a depth map, all views have depths (0 where
    unknown), and likewise disparities; if any has a mask or a distorting lens, all have masks.

    Args:
        height, width: the size of every view, in pixels.
        cache: where decoded pixels are kept.
    """

    def __init__(self, scene: PosedScene, height: int, width: int, cache: ImageCache | None = None):
        self.scene, self.name, self._cache = scene, scene.name, cache
        photographs = scene.photographs
        shape = (len(photographs), -1, -1)
        intrinsics = [resized_intrinsics(p.lens, height, width) for p in photographs]
        poses = [photograph.cam_to_world for photograph in photographs]
        self.cameras = Cameras(
            intrinsics=torch.tensor(np.array(intrinsics), dtype=torch.float32).view(shape[0], 3, 3),
            cam_to_world=torch.tensor(np.array(poses), dtype=torch.float32).view(shape[0], 4, 4),
            height=height,
            width=width,
        )
        self._has_depths = any(photograph.depth for photograph in photographs)
        self._has_disparities = any(photograph.disparity for photograph in photographs)
        self._has_masks = any(p.mask or p.lens.is_distorted for p in photographs)

    @property
    def num_frames(self) -> int:
        return len(self.scene.photographs)

    @property
    def points(self) -> Points | None:
        """Sparse points of the scene's surfaces, read when first asked for; None without any."""
        return self.scene.points

    def views(self, frames: Sequence[int]) -> Views:
        """Return the named frames, in the given order.

        Raises:
            InputError: a file whose pixels are damaged.
        """
        chosen = [self.scene.photographs[frame] for frame in frames]

        def stacked(there: bool, read: Callable[[Photograph], Tensor]) -> Tensor | None:
            return torch.stack([read(photograph) for photograph in chosen]) if there else None

        return Views(
            cameras=self.cameras.select(frames),
            images=stacked(True, self._image),
            depths=stacked(self._has_depths, self._depth),
            masks=stacked(self._has_masks, self._mask),
            disparities=stacked(self._has_disparities, self._disparity),
        )

    def without_damaged(self, bad: BadFrames) -> "FileSequence":
        """Return the frames whose pixels can be read, and note the others in `bad`."""
        whole = []
        for frame, photograph in enumerate(self.scene.photographs):
            with bad.caught():
                self.views([frame])
                whole.append(photograph)
        scene = replace(self.scene, photographs=whole)
        return FileSequence(scene, self.cameras.height, self.cameras.width, self._cache)

    def _image(self, photograph: Photograph) -> Float[Tensor, "3 H W"]:
        pixels = self._pixels(photograph.image, load_photograph, photograph.lens)
        return pixels.permute(2, 0, 1).float() / 255

    def _depth(self, photograph: Photograph) -> Float[Tensor, "H W"]:
        if photograph.depth is None:
            return torch.zeros(self.cameras.height, self.cameras.width)
        stored = self._pixels(photograph.depth, load_depth, photograph.lens, nearest=True)
        return stored * photograph.depth_unit

    def _disparity(self, photograph: Photograph) -> Float[Tensor, "H W"]:
        if photograph.disparity is None:
            return torch.zeros(self.cameras.height, self.cameras.width)
        lens = photograph.lens

        def load_disparity(file: ImageFile) -> ndarray:
            stored = load_depth(file)
            height, width = stored.shape
            # Of a photograph that was since replaced by another.
            if not same_proportions((width, height), (lens.width, lens.height)):
                raise InputError(
                    f"{file} is {width} x {height} and {photograph.image} {lens.width} x "
                    f"{lens.height}: delete it, and estimate it again with python -m "
                    "asysplat.data.disparity."
                )
            return stored

        return self._pixels(photograph.disparity, load_disparity, lens, nearest=True)

    def _mask(self, photograph: Photograph) -> Bool[Tensor, "H W"]:
        lens = photograph.lens
        if photograph.mask is None:
            everywhere = np.ones((lens.height, lens.width), dtype=np.uint8)
            return torch.tensor(self._fit(everywhere, lens, nearest=True)) > 0
        return self._pixels(photograph.mask, load_mask, lens, nearest=True) > 0

    def _pixels(
        self,
        file: ImageFile,
        load: Callable[[ImageFile], ndarray],
        lens: Lens,
        nearest: bool = False,
    ) -> Tensor:
        """Return a file's pixels at this sequence's size, from the cache if they are there."""

        def make() -> ndarray:
            return self._fit(load(file), lens, nearest)

        if self._cache is None:
            pixels = make()
        else:
            size = (self.cameras.height, self.cameras.width)
            key = "-".join((content_hash(file), _hash(lens, *size, load.__name__)))
            # Pixels that are neither undistorted nor resized are as quickly decoded again.
            changed = lens.is_distorted or (lens.height, lens.width) != size
            pixels = self._cache.get(key, make, to_disk=changed)
        # A copy, since arrays from the cache and from Pillow are read-only.
        return torch.tensor(pixels)

    def _fit(self, pixels: ndarray, lens: Lens, nearest: bool = False) -> ndarray:
        if pixels.dtype == bool:
            pixels = pixels.astype(np.uint8)
        pixels = undistort(pixels, lens, nearest)
        return resize_and_crop(pixels, self.cameras.height, self.cameras.width, nearest)


def _hash(*values) -> str:
    return hashlib.blake2b(repr(values).encode(), digest_size=8).hexdigest()
