"""Videos (mp4) that browsers play."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from asysplat.errors import InputError
from asysplat.files import atomic_write

ENCODING = {"crf": "18"}  # x264's quality: visually lossless
BT709 = 1  # its number in H.264
INDEX_FIRST = {"movflags": "+faststart"}  # browsers start before the download ends


def write_video(
    path: str | Path, images: Iterable[Float[Tensor, "3 H W"]], fps: int | float = 30
) -> None:
    """Write RGB images of one size, clamped to [0, 1], as H.264 in yuv420p, one at a time.

    The last row or column is repeated where a height or width is odd.

    Raises:
        InputError: PyAV is missing, another suffix, no image, NaN, images of different sizes, or a
            file that cannot be written.
    """
    try:
        import av  # optional dependency
    except ImportError as error:
        raise InputError("write_video needs PyAV: pip install 'asysplat[video]'.") from error
    if Path(path).suffix.lower() != ".mp4":
        raise InputError(f"{path} is not the name of a video: give one that ends in .mp4.")
    if not fps > 0:
        raise InputError(f"fps is {fps}: give frames per second, more than 0.")
    stream = None
    with atomic_write(path) as partial, av.open(partial, "w", options=INDEX_FIRST) as container:
        for index, image in enumerate(images):
            pixels = _pixels(image, f"image {index} of {path}")
            if stream is None:
                rate = Fraction(fps).limit_denominator(1001)
                stream = container.add_stream("libx264", rate, options=ENCODING)
                stream.pix_fmt, stream.height, stream.width = "yuv420p", *pixels.shape[:2]
                # Explicit, as players guess differently for small and large images.
                for field in ("colorspace", "color_primaries", "color_trc"):
                    setattr(stream.codec_context, field, BT709)
            if pixels.shape[:2] != (stream.height, stream.width):
                raise InputError(
                    f"image {index} of {path} is {tuple(image.shape)}, others were "
                    f"{stream.height} x {stream.width}: give images of one size."
                )
            frame = av.VideoFrame.from_ndarray(pixels, "rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=BT709)
            container.mux(stream.encode(frame))
        if stream is None:
            raise InputError(f"{path} has no images: give at least one.")
        container.mux(stream.encode())


def _pixels(image: Float[Tensor, "3 H W"], where: str) -> UInt8[ndarray, "H2 W2 3"]:
    """Return an image in 8 bits, its height and width even."""
    if image.isnan().any():
        raise InputError(f"{where} holds NaN: render finite colors.")
    height, width = image.shape[1:]
    levels = (image.detach().cpu().clamp(0, 1) * 255).round()
    padding = (0, width % 2, 0, height % 2)
    padded = torch.nn.functional.pad(levels[None], padding, mode="replicate")[0]
    return padded.to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
