"""Estimate disparities of photographs with Depth Anything (Yang et al. 2024)."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from io import BytesIO
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, Shaped, UInt8
from numpy import ndarray
from PIL import Image
from torch import nn

from asysplat.data.bad_images import BadImages
from asysplat.data.images import PANORAMA, EncodedImage, ImageFile, load_image
from asysplat.data.sequence import PosedImage, PosedScene
from asysplat.errors import InputError

MODEL = "LiheYoung/depth-anything-small-hf"  # the weights that Long-LRM trains with; Apache-2.0
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # statistics of ImageNet, RGB
SHORT_SIDE = 518  # pixels of the shorter side in the network's training
PNG = {"format": "PNG"}
BATCH = 16  # photographs of one size
MAX_SHORT_SIDE = 272  # pixels of a map: the loss compares every second pixel of 544
LEVELS = 4095  # levels of a map: finer than any network's precision, and PNG packs 12 bits well
Estimate = Callable[[UInt8[ndarray, "B h w 3"]], Float32[ndarray, "B H W"]]


def with_disparities(scene: PosedScene, estimate: Estimate, bad: BadImages) -> PosedScene:
    """Return a scene whose images have estimated disparities, at most MAX_SHORT_SIDE pixels high.

    Errors of images that cannot be read are collected. Panoramas have none, as networks are made
    for perspective images.
    """

    def read(image: PosedImage) -> tuple[PosedImage, UInt8[ndarray, "h w 3"]]:
        return image, load_image(image.file)

    estimated: list[PosedImage] = []
    for start in range(0, len(scene.images), BATCH):
        chunk = scene.images[start : start + BATCH]
        plain = ((image,) for image in chunk if image.lens.model != PANORAMA)
        maps: dict[ImageFile, EncodedImage] = {}
        by_size = defaultdict(list)
        for image, pixels in bad.read_each(read, plain):
            by_size[pixels.shape[:2]].append((image.file, pixels))
        for size, same in by_size.items():
            disparities = estimate(np.stack([pixels for _, pixels in same]))
            for (file, _), disparity in zip(same, disparities, strict=True):
                stored = encode_map(shrink(disparity, *size))
                maps[file] = EncodedImage(f"disparity of {file}", partial(bytes, stored))
        for image in chunk:
            if image.file in maps or image.lens.model == PANORAMA:
                estimated.append(replace(image, disparity=maps.get(image.file)))
    return replace(scene, images=estimated)


def shrink(disparity: Float32[ndarray, "H W"], height: int, width: int) -> Float32[ndarray, "h w"]:
    """Resample the map of an image of height x width to the image's proportions, by area."""
    scale = min(1.0, MAX_SHORT_SIDE / min(height, width))
    size = (round(scale * height), round(scale * width))
    return F.interpolate(torch.as_tensor(disparity)[None, None], size, mode="area")[0, 0].numpy()


def encode_map(disparity: Float32[ndarray, "h w"]) -> bytes:
    """Return disparities as a 16-bit PNG: 1 for the least, LEVELS for the greatest.

    Scale and shift are not stored, since the loss ignores them; 0 means unknown.
    """
    if not np.isfinite(disparity).all():
        raise InputError("--disparities gives NaN or infinity: name another model.")
    low, high = float(disparity.min()), float(disparity.max())
    fraction = (disparity - low) / max(high - low, np.finfo(np.float32).tiny)
    return image_bytes((1 + np.round(fraction * (LEVELS - 1))).astype(np.uint16), **PNG)


def image_bytes(pixels: Shaped[ndarray, "h w *channels"], **options: Any) -> bytes:
    """Encode an image with Pillow's options."""
    stream = BytesIO()
    Image.fromarray(pixels).save(stream, **options)
    return stream.getvalue()


class DepthAnything:
    """Estimates disparities of images, up to scale and shift, with a network of transformers."""

    def __init__(self, network: nn.Module, device: torch.device):
        self.network, self.device = network.to(device).eval(), device
        config: Any = network.config  # transformers' own type
        self.patch_size: int = config.patch_size
        self.mean, self.std = (
            torch.tensor(rgb, device=device)[:, None, None] for rgb in (MEAN, STD)
        )

    @torch.inference_mode()
    def __call__(self, images: UInt8[ndarray, "B h w 3"]) -> Float[ndarray, "B H W"]:
        """Return the disparities of whole images, at the network's own size."""
        pixels = torch.tensor(images, device=self.device).permute(0, 3, 1, 2) / 255
        size = network_size(*images.shape[1:3], self.patch_size)
        pixels = F.interpolate(pixels, size, mode="bicubic", antialias=True)
        output = self.network(pixel_values=(pixels - self.mean) / self.std)
        return output.predicted_depth.float().cpu().numpy()


def network_size(height: int, width: int, patch: int) -> tuple[int, int]:
    """Return the size in whole patches that is nearest to the image's proportions."""
    scale = SHORT_SIDE / min(height, width)
    rows, columns = (max(1, round(scale * side / patch)) for side in (height, width))
    return rows * patch, columns * patch


@cache
def load_depth_anything(model: str, download: bool) -> DepthAnything:
    """Load a network of relative depth with transformers."""
    try:
        # Extra that is missing where types are checked.
        from transformers import AutoModelForDepthEstimation  # ty: ignore[import-not-found]
    except ImportError as error:
        raise InputError(
            "--disparities needs transformers: pip install 'asysplat[disparity]'."
        ) from error
    try:
        network = AutoModelForDepthEstimation.from_pretrained(
            model, local_files_only=not download, use_safetensors=True
        )
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"--disparities {model} cannot be loaded ({reason}): name a folder with config.json "
            "and model.safetensors, or let --download fetch it."
        ) from error
    kind = getattr(network.config, "depth_estimation_type", "relative")
    if kind != "relative":
        raise InputError(
            f"--disparities {model} estimates {kind} depth, not disparities: name a model of "
            f"relative depth, such as {MODEL}."
        )
    return DepthAnything(network, torch.device("cuda" if torch.cuda.is_available() else "cpu"))
