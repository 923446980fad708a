"""Define protocols: named options of the metrics, which their numbers depend on."""

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
    """Computes metrics with fixed options; numbers of different protocols cannot be compared.

    Pixels that a view's mask excludes are copied from the target image in every image metric and
    left out of every depth metric.

    Args:
        name: printed with the numbers.
        eight_bit: whether to truncate renderings to 8 bits a channel first, as in an image file.
        ssim_window, ssim_covariance: see `metrics.ssim`.
        lpips_net: LPIPS' backbone, "alex" or "vgg".
        mean_over: "images": all images alike, or "scenes": first the mean of each scene's images.
        depth_alignment: see `metrics.abs_rel`; for data without metric depth "median".

    Raises:
        InputError: an option is none of its choices.
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
        """Raise InputError if images of this size cannot be measured."""
        check_ssim_size(height, width, self.ssim_window)

    def psnr(self, rendered: Images, targets: Views) -> PerView:
        """Compute the PSNR of each image in dB."""
        return psnr(self._prepare(rendered, targets), targets.images)

    def image_metrics(
        self, rendered: Images, targets: Views, lpips: LPIPS | None
    ) -> dict[str, PerView]:
        """Compute PSNR, SSIM and LPIPS of each image.

        Args:
            lpips: network with the backbone `lpips_net`, see `load_lpips`; None for no LPIPS.
        """
        prepared, target = self._prepare(rendered, targets), targets.images
        values = {
            "psnr": psnr(prepared, target),
            "ssim": ssim(prepared, target, self.ssim_window, self.ssim_covariance),
        }
        if lpips is not None:
            values["lpips"] = lpips_distance(lpips, prepared, target)
        return values

    def without_lpips(self) -> str:
        """Return a warning that LPIPS is not computed, and how to get its backbone."""
        return (
            f"{BACKBONES[self.lpips_net]} is neither in torch's hub cache nor in paths.weights: "
            "the run goes on without LPIPS; paths.download=true fetches it."
        )

    def _prepare(self, rendered: Images, targets: Views) -> Images:
        """Clamp to [0, 1], truncate to 8 bits if set, and copy the target at excluded pixels."""
        rendered = rendered.float().clamp(0, 1)
        return targets.masked((rendered * 255).floor() / 255 if self.eight_bit else rendered)

    def depth_metrics(self, depth: Depths, targets: Views) -> dict[str, PerView]:
        """Compute AbsRel and delta < 1.25 of each view; {} if the data has no depths."""
        if targets.depths is None:
            return {}
        target = targets.depths
        if targets.masks is not None:
            target = target.where(targets.masks, 0)
        return {
            "absrel": abs_rel(depth, target, self.depth_alignment),
            "delta1": delta1(depth, target, self.depth_alignment),
        }

    def sentences(self) -> dict[str, str]:
        """Return the protocol's name and a sentence for each metric."""
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
        pixels = "the pixels of a view that its mask includes and whose depth is known"
        return {
            "name": self.name,
            "psnr": f"{images}, from each image's own MSE (at most 100 dB), {mean}",
            "ssim": f"{images}, {window}, data range 1, {self.ssim_covariance} covariance, "
            f"windows wholly inside the image, mean over channels, {mean}",
            "lpips": f"v0.1 with {BACKBONES[self.lpips_net]}, {images} and scaled to [-1, 1], "
            f"full resolution, {mean}",
            "absrel": f"mean of |d - t| / t over {pixels}, {aligned}, {mean}",
            "delta1": f"share with max(d/t, t/d) < 1.25 of {pixels}, {aligned}, {mean}",
        }
