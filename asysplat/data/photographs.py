"""Photographs on disk with known cameras: what the readers of file formats have in common."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from asysplat.data.images import (
    Lens,
    load_depth,
    load_mask,
    load_photograph,
    resize_and_crop,
    resized_intrinsics,
    undistort,
)
from asysplat.scene import Cameras, Views


@dataclass(frozen=True)
class Photograph:
    """One image file, how it was taken, and what lies beside it.

    Args:
        cam_to_world: rigid, OpenCV axes.
        depth: one-channel integer image of distances along z, `depth_unit` scene units each.
        mask: image that is not 0 where the pixel counts.
    """

    image: Path
    lens: Lens
    cam_to_world: Float[ndarray, "4 4"]
    depth: Path | None = None
    depth_unit: float = 1.0
    mask: Path | None = None


class PhotographCapture:
    """Photographs in the order they were taken, as a `Capture`.

    Pixels are read when `views` asks for them: undistorted, resized until the shorter side fits,
    and cropped to the centre. If any photograph has a depth map, all views have depths (0 where
    unknown); if any has a mask or a distorting lens, all have masks.

    Args:
        height, width: the size of every view, in pixels.
    """

    def __init__(self, name: str, photographs: Sequence[Photograph], height: int, width: int):
        self.name = name
        self._photographs = photographs
        lenses = [photograph.lens for photograph in photographs]
        intrinsics = np.stack([resized_intrinsics(lens, height, width) for lens in lenses])
        poses = np.stack([photograph.cam_to_world for photograph in photographs])
        self.cameras = Cameras(
            intrinsics=torch.from_numpy(intrinsics).float(),
            cam_to_world=torch.from_numpy(poses).float(),
            height=height,
            width=width,
        )
        self._has_depths = any(photograph.depth for photograph in photographs)
        self._has_masks = any(photograph.mask for photograph in photographs) or any(
            lens.is_distorted for lens in lenses
        )

    @property
    def num_frames(self) -> int:
        return len(self._photographs)

    def views(self, frames: Sequence[int]) -> Views:
        """The named frames, in the given order.

        Raises:
            InputError: a file whose pixels are damaged.
        """
        chosen = [self._photographs[frame] for frame in frames]
        return Views(
            cameras=self.cameras.select(frames),
            images=torch.stack([self._image(p) for p in chosen]),
            depths=torch.stack([self._depth(p) for p in chosen]) if self._has_depths else None,
            masks=torch.stack([self._mask(p) for p in chosen]) if self._has_masks else None,
        )

    def _image(self, photograph: Photograph) -> Float[Tensor, "3 H W"]:
        pixels = self._fit(load_photograph(photograph.image), photograph.lens)
        return pixels.permute(2, 0, 1).float() / 255

    def _depth(self, photograph: Photograph) -> Float[Tensor, "H W"]:
        if photograph.depth is None:
            return torch.zeros(self.cameras.height, self.cameras.width)
        stored = self._fit(load_depth(photograph.depth), photograph.lens, nearest=True)
        return stored * photograph.depth_unit

    def _mask(self, photograph: Photograph) -> Bool[Tensor, "H W"]:
        lens = photograph.lens
        if photograph.mask is None:
            mask = np.ones((lens.height, lens.width), dtype=bool)
        else:
            mask = load_mask(photograph.mask)
        return self._fit(mask.astype(np.uint8), lens, nearest=True) > 0

    def _fit(self, pixels: ndarray, lens: Lens, nearest: bool = False) -> Tensor:
        pixels = undistort(pixels, lens, nearest)
        pixels = resize_and_crop(pixels, self.cameras.height, self.cameras.width, nearest)
        # A copy, since Pillow lends its memory read-only.
        return torch.from_numpy(pixels.copy())
