"""What decoding every frame once tells."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.data.bad_frames import BadFrames
from asysplat.data.photographs import PhotographCapture

SAMPLED = 97  # every such depth; a prime, so that no column of pixels is favoured

Quartiles = tuple[float, float, float]


@dataclass(frozen=True)
class Pixels:
    """Of all frames that can be decoded.

    Args:
        brightness: of the darkest and the brightest image, the mean of its colours in [0, 1].
        depth_known: share of the pixels whose depth is known; None without depth maps.
        depths: quartiles of those depths, in scene units.
        counted: share of the pixels that count; None without masks.
    """

    brightness: tuple[float, float]
    depth_known: float | None
    depths: Quartiles | None
    counted: float | None


def read_pixels(
    capture: PhotographCapture, bad: BadFrames, step: Callable[[], None] = lambda: None
) -> tuple[PhotographCapture, Pixels]:
    """Decode every frame once.

    Args:
        bad: notes the frames that cannot be decoded; the capture that is returned lacks them.
        step: called after each frame.

    Raises:
        InputError: too few frames can be used, or some cannot and must not be skipped.
    """
    whole, brightness, known, counted, depths = [], [], [], [], []
    for frame, photograph in enumerate(capture.scene.photographs):
        with bad.caught():
            views = capture.views([frame])
            whole.append(photograph)
            brightness.append(float(views.images.mean()))
            if views.depths is not None:
                known.append(float((views.depths > 0).double().mean()))
                depths.append(views.depths.flatten()[::SAMPLED])
            if views.masks is not None:
                counted.append(float(views.masks.double().mean()))
        step()
    bad.settle(capture.name, len(whole))
    scene = replace(capture.scene, photographs=whole)
    sampled = torch.cat(depths) if depths else torch.empty(0)
    return PhotographCapture(scene, capture.cameras.height, capture.cameras.width), Pixels(
        brightness=(min(brightness), max(brightness)),
        depth_known=_mean(known),
        depths=quartiles(sampled[sampled > 0]),
        counted=_mean(counted),
    )


def quartiles(values: Float[Tensor, " N"]) -> Quartiles | None:
    """None of nothing."""
    if not len(values):
        return None
    low, middle, high = values.double().quantile(values.new_tensor([0.25, 0.5, 0.75]).double())
    return float(low), float(middle), float(high)


def _mean(shares: list[float]) -> float | None:
    return sum(shares) / len(shares) if shares else None
