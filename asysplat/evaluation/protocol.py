"""Protocols: the settings that a metric's number depends on, under a name."""

from dataclasses import dataclass, fields
from typing import Literal, get_args, get_type_hints

from lpips import LPIPS

from asysplat.errors import InputError
from asysplat.evaluation.lpips import lpips_distance
from asysplat.evaluation.metrics import (
    SSIM_SIGMA,
    SSIM_WINDOWS,
    Alignment,
    Covariance,
    Depths,
    Images,
    PerView,
    Window,
    abs_rel,
    check_ssim_size,
    delta1,
    psnr,
    ssim,
)
from asysplat.scene import Views

BACKBONES = {"alex": "AlexNet", "vgg": "VGG16"}


@dataclass(frozen=True)
class Protocol:
    """How renderings are measured: the same images differ by dB and hundredths between protocols.

    Pixels that a view's mask excludes are as in the photograph for every image metric, and count
    for no depth metric.

    Args:
        name: stands beside the numbers.
        eight_bit: renderings are first cut to 8 bits a channel, as in an image file.
        ssim_window, ssim_covariance: see `metrics.ssim`.
        lpips_net: LPIPS' backbone, "alex" or "vgg".
        mean_over: every "images" alike, or every "scenes": the mean of each scene's images first.
        depth_alignment: see `metrics.abs_rel`; for data without metric depth "median".

    Raises:
        InputError: a setting that is none of the choices.
    """

    name: str
    eight_bit: bool
    ssim_window: Window
    ssim_covariance: Covariance
    lpips_net: Literal["alex", "vgg"]
    mean_over: Literal["images", "scenes"]
    depth_alignment: Alignment

    def __post_init__(self):
        hints = get_type_hints(type(self))
        for field in fields(self):
            value, hint = getattr(self, field.name), hints[field.name]
            choices = (True, False) if hint is bool else get_args(hint)
            if choices and value not in choices:
                raise InputError(
                    f"metrics.{field.name} is {value!r}: choose {' or '.join(map(str, choices))}."
                )

    def check_size(self, height: int, width: int) -> None:
        """Raise InputError for images that cannot be measured."""
        check_ssim_size(height, width, self.ssim_window)

    def psnr(self, rendered: Images, targets: Views) -> PerView:
        """PSNR of each image in dB."""
        return psnr(self._shown(rendered, targets), targets.images)

    def image_metrics(
        self, rendered: Images, targets: Views, lpips: LPIPS | None
    ) -> dict[str, PerView]:
        """PSNR, SSIM and LPIPS of each image.

        Args:
            lpips: a network with the backbone `lpips_net`, see `load_lpips`; None: no LPIPS.
        """
        shown, target = self._shown(rendered, targets), targets.images
        values = {
            "psnr": psnr(shown, target),
            "ssim": ssim(shown, target, self.ssim_window, self.ssim_covariance),
        }
        if lpips is not None:
            values["lpips"] = lpips_distance(lpips, shown, target)
        return values

    def _shown(self, rendered: Images, targets: Views) -> Images:
        """In [0, 1] and, where so set, cut to 8 bits; the photograph where pixels do not count."""
        rendered = rendered.float().clamp(0, 1)
        return targets.masked((rendered * 255).floor() / 255 if self.eight_bit else rendered)

    def depth_metrics(self, depth: Depths, targets: Views) -> dict[str, PerView]:
        """AbsRel and delta < 1.25 of each view; none where the data has no depths."""
        if targets.depths is None:
            return {}
        known = targets.depths if targets.masks is None else targets.depths.where(targets.masks, 0)
        return {
            "absrel": abs_rel(depth, known, self.depth_alignment),
            "delta1": delta1(depth, known, self.depth_alignment),
        }

    def sentences(self) -> dict[str, str]:
        """The protocol's name, and what was computed for each metric."""
        size = SSIM_WINDOWS[self.ssim_window]
        window = f"{self.ssim_window} window {size}x{size}"
        if self.ssim_window == "gaussian":
            window = f"{window} sigma {SSIM_SIGMA}".replace("gaussian", "Gaussian")
        cut = " and cut to 8 bits" if self.eight_bit else ""
        images = f"RGB in [0, 1], rendering clamped{cut}"
        mean = "mean over images"
        if self.mean_over == "scenes":
            mean = "mean over a scene's images, then over scenes"
        aligned = "depth not aligned"
        if self.depth_alignment == "median":
            aligned = "depth of each view scaled to the true median"
        known = "the pixels of a view that its mask includes and whose depth is known"
        return {
            "name": self.name,
            "psnr": f"{images}, from each image's own MSE (at most 100 dB), {mean}",
            "ssim": f"{images}, {window}, data range 1, {self.ssim_covariance} covariance, "
            f"windows wholly inside the image, mean over channels, {mean}",
            "lpips": f"v0.1 with {BACKBONES[self.lpips_net]}, {images} and scaled to [-1, 1], "
            f"full resolution, {mean}",
            "absrel": f"mean of |d - t| / t over {known}, {aligned}, {mean}",
            "delta1": f"share with max(d/t, t/d) < 1.25 of {known}, {aligned}, {mean}",
        }
