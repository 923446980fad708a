"""Select the sharp frames of a video."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image
from rich.progress import Progress

from asysplat.errors import InputError

SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm")
COMPARED_SIDE = 640  # pixels of the longer side at which sharpness is compared


def save_sharp_frames(video: Path, folder: Path, count: int, progress: Progress) -> None:
    """Save the sharpest frame of each of `count` equal parts of a video, upright, as NNNNN.png."""
    with _video(video) as (container, stream):
        times = sorted(packet.pts for packet in container.demux(stream) if packet.pts is not None)
    if not times:
        raise InputError(f"{video} has no frames: record or copy it again.")
    first, length = times[0], times[-1] - times[0] + 1
    task = progress.add_task("frames", total=len(times))
    best: tuple[float, UInt8[ndarray, "h w 3"]] | None = None
    part = 0

    def save() -> None:
        if best is not None:
            Image.fromarray(best[1]).save(folder / f"{part:05d}.png")

    with _video(video) as (container, stream):
        for frame in container.decode(stream):
            progress.advance(task)
            if frame.pts is None:
                continue
            current = (frame.pts - first) * count // length
            if current != part:
                save()
                part, best = current, None
            pixels = frame.to_ndarray(format="rgb24")
            sharp = _sharpness(pixels)
            if best is None or sharp > best[0]:
                best = sharp, np.ascontiguousarray(np.rot90(pixels, frame.rotation // 90))
        save()


@contextmanager
def _video(path: Path) -> Generator[tuple[Any, Any]]:  # of PyAV, an optional dependency
    """Open a video, and yield it and its stream of images."""
    try:
        import av  # optional dependency
    except ImportError as error:
        raise InputError(
            f"{path} is a video, which needs PyAV: pip install 'asysplat[video]'."
        ) from error
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path} has no images, only sound: name a video.")
            container.streams.video[0].thread_type = "AUTO"
            yield container, container.streams.video[0]
    except av.FFmpegError as error:
        raise InputError(
            f"{path} cannot be read as a video ({error.strerror}): copy or convert it again."
        ) from error


def _sharpness(pixels: UInt8[ndarray, "h w 3"]) -> float:
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    scale = COMPARED_SIDE / max(gray.shape)
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())
