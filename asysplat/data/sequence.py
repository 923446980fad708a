"""Posed images of one place: the interface that all of them follow, and the images on disk."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from torch import Tensor

from asysplat.data.bad_images import BadImages, Policy
from asysplat.data.images import (
    ImageFile,
    Lens,
    Resampling,
    load_alpha,
    load_depth,
    load_mask,
    load_reduced,
    resize_and_crop,
    resized_intrinsics,
    undistort,
)
from asysplat.scene import Cameras, Views

# A scene is moved if its cameras are this far from the origin, in units and in their extent.
FAR = 100.0
OVERSAMPLING = 4  # least pixels along a side from which one of a view is computed
MIN_EXTENT = 1e-9  # cameras' extent over their distance from the origin: less is rounding
Points = Float[ndarray, "P 3"]
MasksOf = Literal["auto", "object", "ignore", "find"]


@runtime_checkable
class Load(Protocol):
    """A function that reads the pixels of a file."""

    __name__: str

    def __call__(self, path: ImageFile, /) -> ndarray: ...


@runtime_checkable
class ImageSequence(Protocol):
    """Images of one static place, in the order they were taken; `views` reads their pixels."""

    name: str  # unique within the data set
    num_images: int
    cameras: Cameras  # cameras of all images, [num_images, ...]

    @property
    def points(self) -> Points | None:
        """Sparse points of the place's surfaces; None where they are not known."""

    def views(self, indices: Sequence[int]) -> Views:
        """Return the images at `indices`, in that order: pixels in [0, 1], depths where known."""


@dataclass(frozen=True)
class SceneOptions:
    """How scenes on disk are opened.

    Args:
        on_error: "fail" raises one error that names every image that cannot be used; "skip"
            leaves those images out with a warning, and decodes each image once to find them.
        masks: whether masks are of an object or of what to ignore; see `with_masks`.
        resampling: how photographs and alphas are resized, see `Resampling`.
    """

    height: int
    width: int
    layout: str = "auto"
    on_error: Policy = "fail"
    masks: MasksOf = "auto"
    resampling: Resampling = "lanczos"


@dataclass(frozen=True)
class PosedImage:
    """One image file with its lens, its pose, and the maps that belong to it.

    Args:
        cam_to_world: rigid, OpenCV axes.
        depth: one-channel integer image of distances along z, `depth_unit` scene units each.
        mask: image that is 0 where the pixel must be ignored; see `load_mask`.
        is_object: the mask is of an object, and where it is 0 there is nothing; see `load_alpha`.
        held_out: whether the data set keeps the image to measure what was fitted to the others.
        disparity: one-channel integer image of inverse depths, up to a scale and a shift; 0 where
            unknown.
    """

    file: ImageFile
    lens: Lens
    cam_to_world: Float[ndarray, "4 4"]
    depth: ImageFile | None = None
    depth_unit: float = 1.0
    mask: ImageFile | None = None
    is_object: bool = False
    held_out: bool = False
    disparity: ImageFile | None = None


@dataclass(frozen=True)
class PosedScene:
    """The content of a scene's files, as a reader returns it.

    Args:
        images: in the order they were taken.
        read_points: reads sparse points of the scene's surfaces; None where the files have none.
        origin: origin of the poses and points, in the coordinates of the files; see `near_origin`.
    """

    name: str
    images: list[PosedImage]
    read_points: Callable[[], Points | None] | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def held_out(self) -> list[int]:
        """The indices of the images that the data set holds out."""
        return [index for index, image in enumerate(self.images) if image.held_out]

    @cached_property
    def points(self) -> Points | None:
        """Sparse points, read at the first access: they may take longer than all the rest."""
        points = self.read_points() if self.read_points else None
        return None if points is None else points - self.origin


def near_origin(scene: PosedScene) -> PosedScene:
    """Move a scene that is far from the origin, such as a geo-referenced one, to its cameras' mean.

    Float32 would not resolve its poses. The mean is rounded to whole units.
    """
    centers = np.array([image.cam_to_world[:3, 3] for image in scene.images]).reshape(-1, 3)
    if any(scene.origin) or not np.isfinite(centers).all() or not len(centers):
        return scene
    distance, extent = np.abs(centers).max(), np.ptp(centers, axis=0).max()
    if distance < FAR or distance < FAR * extent or extent < MIN_EXTENT * distance:
        return scene
    origin = centers.mean(0).round()
    images = []
    for image in scene.images:
        pose = image.cam_to_world.astype(np.float64)
        pose[:3, 3] -= origin
        images.append(replace(image, cam_to_world=pose))
    return replace(scene, images=images, origin=tuple(origin.tolist()))


class FileSequence:
    """Images on disk, as an `ImageSequence`.

    `views` reads pixels, undistorts them, resizes them until the shorter side fits, and crops them
    to the center. If any image has a depth map, all views have depths (0 where unknown), and
    likewise disparities and alphas (1 where unknown); if any has a mask or a distorting lens, all
    have masks. Transparent pixels are white.
    """

    def __init__(self, scene: PosedScene, options: SceneOptions):
        self.scene = scene = near_origin(scene)
        self.name, self.options = scene.name, options
        self.num_images = len(scene.images)
        images, (height, width) = scene.images, (options.height, options.width)
        intrinsics = np.array([resized_intrinsics(image.lens, height, width) for image in images])
        poses = np.array([image.cam_to_world for image in images])
        self.cameras = Cameras(
            torch.tensor(intrinsics, dtype=torch.float32).view(len(images), 3, 3),
            torch.tensor(poses, dtype=torch.float32).view(len(images), 4, 4),
            *(height, width),
        )
        self._has_depths = any(image.depth for image in images)
        self._has_disparities = any(image.disparity for image in images)
        self._has_alphas = any(image.is_object for image in images)
        self._has_masks = any(
            (image.mask and not image.is_object) or image.lens.is_distorted for image in images
        )

    @property
    def points(self) -> Points | None:
        return self.scene.points

    def views(self, indices: Sequence[int]) -> Views:
        return self.stored(indices).decoded()

    def stored(self, indices: Sequence[int]) -> Views:
        """Return the images at `indices`, in that order, as uint8."""
        images = [self.scene.images[index] for index in indices]

        def stack(available: bool, read: Callable[[PosedImage], Tensor]) -> Tensor | None:
            return torch.stack([read(image) for image in images]) if available else None

        return Views(
            cameras=self.cameras.select(indices),
            images=torch.stack([self._image(image) for image in images]),
            depths=stack(self._has_depths, self._depth),
            masks=stack(self._has_masks, self._mask),
            alphas=stack(self._has_alphas, self._alpha),
            disparities=stack(self._has_disparities, self._disparity),
        )

    def with_images(self, images: list[PosedImage]) -> "FileSequence":
        """Return a sequence of the same size with some of this one's images."""
        return FileSequence(replace(self.scene, images=images), self.options)

    def without_damaged(self, bad: BadImages) -> "FileSequence":
        """Return the images whose pixels can be read, and collect the errors of the others."""
        intact = []
        for index, image in enumerate(self.scene.images):
            with bad.collect():
                self.views([index])
                intact.append(image)
        return self.with_images(intact)

    def _image(self, image: PosedImage) -> UInt8[Tensor, "3 H W"]:
        # A reduced image is antialiased.
        factor = math.inf if self.options.resampling == "bilinear" else OVERSAMPLING
        least = factor * max(self.options.height, self.options.width)

        def load_photograph(file: ImageFile) -> ndarray:
            return load_reduced(file, least)

        pixels = self._pixels(image.file, load_photograph, image.lens).permute(2, 0, 1)
        # Transparent photographs and prepared ones are on white.
        if image.is_object and isinstance(image.mask, Path) and image.mask != image.file:
            return (255 - self._alpha(image) * (255 - pixels.float())).round().byte()
        return pixels

    def _alpha(self, image: PosedImage) -> Float[Tensor, "H W"]:
        if image.mask is None or not image.is_object:
            return torch.ones(self.options.height, self.options.width)
        return self._pixels(image.mask, load_alpha, image.lens).float() / 255

    def _depth(self, image: PosedImage) -> Float[Tensor, "H W"]:
        return self._map(image.depth, load_depth, image.lens) * image.depth_unit

    def _disparity(self, image: PosedImage) -> Float[Tensor, "H W"]:
        return self._map(image.disparity, load_depth, image.lens)

    def _mask(self, image: PosedImage) -> Bool[Tensor, "H W"]:
        lens = image.lens
        if image.mask is None or image.is_object:
            return torch.tensor(self._fit(np.ones((lens.height, lens.width), dtype=bool), lens))
        return self._pixels(image.mask, load_mask, lens)

    def _map(self, file: ImageFile | None, load: Load, lens: Lens) -> Float[Tensor, "H W"]:
        """Return unmixed values at this sequence's size; 0 without a file."""
        if file is None:
            return torch.zeros(self.options.height, self.options.width)
        return self._pixels(file, load, lens, nearest=True)

    def _pixels(self, file: ImageFile, load: Load, lens: Lens, nearest: bool = False) -> Tensor:
        """Return a file's pixels at this sequence's size."""
        # A copy, since arrays from Pillow are read-only.
        return torch.tensor(self._fit(load(file), lens, nearest))

    def _fit(self, pixels: ndarray, lens: Lens, nearest: bool = False) -> ndarray:
        pixels = undistort(pixels, lens, nearest)
        options = self.options
        size = options.height, options.width
        return resize_and_crop(pixels, *size, nearest, options.resampling)
