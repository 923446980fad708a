"""Read images, depth maps and masks from files, undistort them and resize them.

Pixel positions count from the image's corner: the first pixel's center is at +0.5. Nothing is ever
written. The exif orientation is not applied, since calibrations are for the pixels as stored. All
functions that read raise an InputError for a file that is missing, empty, damaged or cut short.
"""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from io import BytesIO
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Float32, Shaped, UInt8
from numpy import ndarray
from PIL import Image
from PIL.ImageFile import ImageFile as OpenedImage

from asysplat.errors import InputError

HEIF = (".heic", ".heif")  # suffixes of what phones save
# Pillow goes by the content and knows more, some of which start other programs (EPS).
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
END_MARKERS = {"JPEG": b"\xff\xd9", "PNG": b"IEND"}
TAIL_BYTES = 4096  # some cameras append data after the end marker
WHOLE = 0.9999  # fraction of a pixel, as rounded, from which all of it is covered
PANORAMA = "EQUIRECTANGULAR"  # COLMAP's model of an image of all directions
OUTSIDE = -1.0  # a position beyond the border of every image
TWO_FOCALS = {  # COLMAP's models with one focal length; with two, more parameters follow, all 0
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_DIVISION": "DIVISION",
    "SIMPLE_FISHEYE": "FISHEYE",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An image file inside another file, whose bytes `read` returns; `name` is for messages."""

    name: str
    read: Callable[[], bytes]

    def __str__(self) -> str:
        return self.name


ImageFile = Path | EncodedImage
Content = TypeVar("Content")
# The first two are antialiased; bilinear is between the four nearest pixels alone, as Long-LRM's.
Resampling = Literal["lanczos", "bicubic", "bilinear"]


@dataclass(frozen=True)
class Lens:
    """The camera model of one image.

    Args:
        width, height: the image's size in pixels; of a face of a panorama, the face's.
        fx, fy, cx, cy: pinhole intrinsics in pixels; of a panorama and its faces, fx and fy are the
            panorama's pixels per radian.
        model: name of a model of COLMAP that has a focal length, or PANORAMA.
        distortion: the model's other parameters, in COLMAP's order.
        yaw: turn of a face to the right of the panorama's middle, in degrees.

    https://github.com/colmap/colmap/blob/main/src/colmap/sensor/models.h
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    distortion: tuple[float, ...] = ()
    yaw: float = 0.0

    @staticmethod
    def from_camera(camera: pycolmap.Camera) -> "Lens":
        """Return the lens of COLMAP's camera, which must have a focal length."""
        return Lens(
            camera.width,
            camera.height,
            camera.focal_length_x,
            camera.focal_length_y,
            camera.principal_point_x,
            camera.principal_point_y,
            camera.model_name,
            tuple(camera.params[camera.extra_params_idxs()].tolist()),
        )

    def camera(self) -> pycolmap.Camera:
        """Return COLMAP's camera, with id 0; of the model in TWO_FOCALS if fx and fy differ.

        Of a face, it is the whole panorama's.
        """
        create = pycolmap.Camera.create_from_model_name
        if self.model == PANORAMA:
            return create(0, PANORAMA, 0, round(2 * math.pi * self.fx), round(math.pi * self.fy))
        model, params = self.model, [self.fx, self.fy, self.cx, self.cy, *self.distortion]
        if model in TWO_FOCALS and self.fx == self.fy:
            del params[0]
        else:
            model = TWO_FOCALS.get(model, model)
        camera = create(0, model, self.fx, self.width, self.height)
        camera.params = [*params, *camera.params[len(params) :]]
        return camera

    @cached_property
    def is_distorted(self) -> bool:
        # A fisheye is not a pinhole even with all coefficients 0.
        camera = self.camera()
        pinhole = not (camera.is_perspective_fisheye() or camera.is_spherical())
        return not (pinhole and camera.is_undistorted())

    @property
    def rotation(self) -> Float[ndarray, "3 3"]:
        """Rotation from the pinhole's axes to the image's; of a face, to the panorama's."""
        return cv2.Rodrigues(np.array((0.0, math.radians(self.yaw), 0.0)))[0]


def image_size(path: ImageFile) -> tuple[int, int]:
    """Read (width, height) from the header."""
    return _read(path, _checked_size)


def same_proportions(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Check whether two (width, height) have the same proportions, to a pixel of `one`."""
    return abs(one[0] * other[1] / other[0] - one[1]) <= 1


def load_image(path: ImageFile) -> UInt8[ndarray, "h w 3"]:
    """Read RGB in 0..255, on a white background where the image is transparent."""
    return _read(path, _to_rgb)


def load_reduced(path: ImageFile, least: float | int) -> UInt8[ndarray, "h w 3"]:
    """Read an image as `load_image`, but a JPEG at 1/8, 1/4 or 1/2 of its size, if that is enough.

    Decoding takes less time then. The first fraction is taken that leaves both sides a whole number
    of at least `least` pixels.
    """

    def read(image: OpenedImage) -> UInt8[ndarray, "h w 3"]:
        for factor in (8, 4, 2):
            width, height = (side // factor for side in image.size)
            whole = (width * factor, height * factor) == image.size
            if image.format == "JPEG" and whole and min(width, height) >= least:
                image.draft(None, (width, height))
                break
        return _to_rgb(image)

    return _read(path, read)


def load_depth(path: ImageFile) -> Float32[ndarray, "h w"]:
    """Read the stored integers of a one-channel (16-bit) image; 0 where unknown."""
    stored = _read(path, np.asarray)
    if stored.ndim != 2:
        raise InputError(
            f"{path} has {stored.shape[-1]} channels: give depth as a 16-bit PNG with one channel."
        )
    return stored.astype(np.float32)


def load_mask(path: ImageFile) -> Bool[ndarray, "h w"]:
    """Read a mask: True where the image is opaque; of one without alpha, where it is not black."""
    return _read(path, _to_mask)


def load_alpha(path: ImageFile) -> UInt8[ndarray, "h w"]:
    """Read how opaque an image is, in 0..255; of one without alpha, how bright.

    Values of 0 and 1 alone are 0 and 255.
    """
    return _read(path, _to_alpha)


def has_alpha(path: ImageFile) -> bool:
    """Read from the header whether an image may be transparent."""
    return _read(path, lambda image: image.has_transparency_data)


def undistort(
    pixels: Shaped[ndarray, "h w *channels"], lens: Lens, nearest: bool = False
) -> Shaped[ndarray, "height width *channels"]:
    """Resample to a pinhole camera with the lens's own fx, fy, cx, cy; a panorama, to its face.

    `pixels` may have another size than the image, as depth maps do, if the field of view is the
    same. Beyond the image's border the nearest pixel is repeated, or, with `nearest` (for depths
    and masks, which must not be mixed), the value is 0.
    """
    if not lens.is_distorted:
        return pixels
    if pixels.dtype == bool:
        return undistort(pixels.astype(np.uint8), lens, nearest=True) > 0
    x, y = _undistortion_maps(lens, pixels.shape[1], pixels.shape[0])
    method = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    border = cv2.BORDER_CONSTANT if nearest else cv2.BORDER_REPLICATE
    if lens.model == PANORAMA:  # left of its first column is the last one
        border = cv2.BORDER_WRAP
    return cv2.remap(pixels, x, y, method, borderMode=border)


def resize_and_crop(
    pixels: Shaped[ndarray, "h w *channels"],
    height: int,
    width: int,
    nearest: bool = False,
    resampling: Resampling = "lanczos",
) -> Shaped[ndarray, "height width *channels"]:
    """Crop to the largest centered part with the given proportions; resize to `height` x `width`.

    By `resampling`, or the pixel under each new center with `nearest`; of booleans, True where all
    pixels are that the new one covers.
    """
    if pixels.shape[:2] == (height, width):
        return pixels
    box = _centered_box(pixels.shape[1], pixels.shape[0], height, width)[1:]
    if pixels.dtype == bool:
        coverage = Image.fromarray(pixels.astype(np.float32))
        coverage = coverage.resize((width, height), Image.Resampling.BOX, box)
        return np.asarray(coverage) > WHOLE
    image, size = Image.fromarray(pixels), (width, height)
    if resampling == "bilinear" and not nearest:
        part = Image.Transform.EXTENT
        return np.asarray(image.transform(size, part, box, Image.Resampling.BILINEAR))
    method = Image.Resampling["NEAREST" if nearest else resampling.upper()]
    return np.asarray(image.resize(size, method, box))


def resized_intrinsics(lens: Lens, height: int, width: int) -> Float[ndarray, "3 3"]:
    """Return the pinhole matrix for the output of `resize_and_crop`."""
    scale, left, top, _, _ = _centered_box(lens.width, lens.height, height, width)
    cx, cy = (lens.cx - left) * scale, (lens.cy - top) * scale
    return np.array([[lens.fx * scale, 0.0, cx], [0.0, lens.fy * scale, cy], [0.0, 0.0, 1.0]])


def _centered_box(
    old_width: int, old_height: int, height: int, width: int
) -> tuple[float, float, float, float, float]:
    scale = max(width / old_width, height / old_height)
    left = max(0.0, (old_width - width / scale) / 2)
    top = max(0.0, (old_height - height / scale) / 2)
    return scale, left, top, old_width - left, old_height - top


@lru_cache(maxsize=2)
def _undistortion_maps(
    lens: Lens, width: int, height: int
) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Return x and y in the distorted image, of width x height, for each undistorted pixel."""
    camera, rotation = lens.camera(), lens.rotation
    scale = np.array((width / camera.width, height / camera.height))
    columns, rows = (max(1, round(side)) for side in scale * (lens.width, lens.height))
    maps, rays = np.empty((2, rows, columns), dtype=np.float32), np.ones((columns, 3))
    rays[:, 0] = ((np.arange(columns) + 0.5) / scale[0] - lens.cx) / lens.fx
    for row in range(rows):
        rays[:, 1] = ((row + 0.5) / scale[1] - lens.cy) / lens.fy
        # OpenCV puts the first pixel's center at 0.
        maps[:, row] = (camera.img_from_cam(rays @ rotation.T) * scale - 0.5).T
    x, y = np.nan_to_num(maps, nan=OUTSIDE)  # NaN where the lens does not see
    return x, y


def _to_rgb(image: Image.Image) -> UInt8[ndarray, "h w 3"]:
    if image.mode.startswith(("I", "F")):
        raise ValueError(f"it has mode {image.mode}; save it as 8-bit RGB")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return np.asarray(image.convert("RGB"))


def _to_mask(image: Image.Image) -> Bool[ndarray, "h w"]:
    if image.has_transparency_data:
        return np.asarray(image.convert("RGBA"))[..., 3] == 255
    return np.asarray(image.convert("L")) > 0


def _to_alpha(image: Image.Image) -> UInt8[ndarray, "h w"]:
    if image.has_transparency_data:
        return np.asarray(image.convert("RGBA"))[..., 3]
    values = np.asarray(image.convert("L"))
    return values if values.max(initial=0) > 1 else 255 * values


def content_hash(file: ImageFile) -> str:
    """Hash the stored bytes; a file is read again only if it changes."""
    if isinstance(file, EncodedImage):
        return hashlib.blake2b(file.read(), digest_size=16).hexdigest()
    _check_exists(file)
    stat = file.stat()
    return _hash_file(file, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=65536)
def _hash_file(path: Path, size: int, modified: int) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def _checked_size(image: OpenedImage) -> tuple[int, int]:
    """Return the size; decode a file without an end marker, which fails if it is cut short."""
    marker, stream = END_MARKERS.get(image.format or ""), image.fp
    if marker and stream:
        position = stream.tell()
        stream.seek(max(0, stream.seek(0, 2) - TAIL_BYTES))
        complete = marker in stream.read()
        stream.seek(position)
        if not complete:
            image.load()
    return image.size


def _read(file: ImageFile, extract: Callable[[OpenedImage], Content]) -> Content:
    """Return `extract` of the opened image; every failure becomes an InputError."""
    formats = FORMATS
    if isinstance(file, Path):
        _check_exists(file)
        if file.suffix.lower() in HEIF:
            if not _register_heif():
                raise InputError(
                    f"{file} is HEIF, which needs pillow-heif: pip install 'asysplat[heif]', or "
                    "save it as JPEG."
                )
            formats = (*FORMATS, "HEIF")
    stored = file if isinstance(file, Path) else BytesIO(file.read())
    try:
        with Image.open(stored, formats=formats) as image:
            return extract(image)
    # Damaged files make Pillow raise anything from OSError to SyntaxError.
    except Exception as error:
        raise InputError(
            f"{file} cannot be read as an image ({error}): copy it again, or leave it out."
        ) from error


@cache
def _register_heif() -> bool:
    """Have Pillow read HEIF; return whether it can."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def _check_exists(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path} does not exist: put the image there, or leave it out.")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes): copy it again, or leave it out.")
