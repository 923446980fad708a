"""Define protocols: named options of the metrics, which their numbers depend on."""

import warnings
from typing import Literal

from jaxtyping import Float
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from asysplat.evaluation import metrics
from asysplat.evaluation.lpips import MIN_SIDE, lpips_distance
from asysplat.evaluation.metrics import BASELINES, DEPTH_BASELINES, Depths, Images, PerView
from asysplat.ranges import configured
from asysplat.scene import Views

BACKBONES = {"alex": "AlexNet", "vgg": "VGG16"}


@dataclass(frozen=True, config=configured("metrics"))
class Protocol:
    """Computes metrics with fixed options; numbers of different protocols cannot be compared.

    Pixels that a view's mask excludes are copied from the target image in every image metric, or
    left out of PSNR, and left out of every depth metric.

    Args:
        name: printed with the numbers.
        eight_bit: whether to truncate renderings to 8 bits a channel first, as in an image file.
        ssim_window, ssim_covariance: see `metrics.ssim`.
        lpips_net: LPIPS' backbone, "alex" or "vgg".
        mean_over: "images": all images alike, or "scenes": first the mean of each scene's images.
        depth_alignment: see `metrics.abs_rel`; for data without metric depth "median".
        psnr_over: "images": all pixels, or "masks": those in the masks of the views.
    """

    name: str
    eight_bit: bool
    ssim_window: metrics.Window
    ssim_covariance: metrics.Covariance
    lpips_net: Literal["alex", "vgg"]
    mean_over: Literal["images", "scenes"]
    depth_alignment: metrics.Alignment
    psnr_over: Literal["images", "masks"] = "images"

    def check_size(self, height: int, width: int) -> None:
        """Raise InputError if images of this size cannot be measured; warn if LPIPS cannot be."""
        metrics.check_ssim_size(height, width, self.ssim_window)
        if min(height, width) < MIN_SIDE:
            warnings.warn(
                f"images of {height}x{width} are measured without LPIPS, which needs "
                f"{MIN_SIDE}x{MIN_SIDE} pixels.",
                stacklevel=2,
            )

    def psnr(self, rendered: Images, targets: Views) -> PerView:
        """Compute the PSNR of each image in dB."""
        return self._psnr(self._prepare(rendered, targets), targets)

    def image_metrics(
        self, rendered: Images, targets: Views, lpips: nn.Module | None
    ) -> dict[str, PerView]:
        """Compute PSNR, SSIM and, with the network of `load_lpips`, LPIPS of each image."""
        prepared, target = self._prepare(rendered, targets), targets.images
        values = {
            "psnr": self._psnr(prepared, targets),
            "ssim": metrics.ssim(prepared, target, self.ssim_window, self.ssim_covariance),
        }
        if lpips is not None and min(target.shape[-2:]) >= MIN_SIDE:
            values["lpips"] = lpips_distance(lpips, prepared, target)
        return values

    def without_lpips(self) -> str:
        """Return why LPIPS is not measured without a backbone, and what brings it."""
        return (
            f"not measured, as {BACKBONES[self.lpips_net]} is neither in torch's hub cache nor in "
            "paths.weights; paths.download=true fetches it"
        )

    def _psnr(self, prepared: Images, targets: Views) -> PerView:
        masks = targets.masks if self.psnr_over == "masks" else None
        return metrics.psnr(prepared, targets.images, masks)

    def _prepare(self, rendered: Images, targets: Views) -> Images:
        """Clamp to [0, 1], truncate to 8 bits if set, and copy the target at excluded pixels."""
        rendered = rendered.float().clamp(0, 1)
        return targets.masked((rendered * 255).floor() / 255 if self.eight_bit else rendered)

    def depth_metrics(
        self, depth: Depths, targets: Views, median_depth: Depths | None = None
    ) -> dict[str, PerView]:
        """Compute AbsRel and delta < 1.25 of each view, and AbsRel of depths scaled to the median.

        Args:
            depth: `render`'s expected depth.
            targets: {} is returned if they have no depths.
            median_depth: `render`'s, whose AbsRel and delta are added; it is wrong where it is 0.
        """
        target = targets.known_depths
        if target is None:
            return {}
        values = {
            "absrel": metrics.abs_rel(depth, target, self.depth_alignment),
            "delta1": metrics.delta1(depth, target, self.depth_alignment),
            "absrel_median": metrics.abs_rel(depth, target, "median"),
        }
        if median_depth is not None:
            aligned = median_depth, target, self.depth_alignment
            values["median_depth_absrel"] = metrics.abs_rel(*aligned)
            values["median_depth_delta1"] = metrics.delta1(*aligned)
        return values

    def measure_views(
        self,
        rendered: Float[Tensor, "V 3 H W"],
        depths: Float[Tensor, "V H W"] | None,
        targets: Views,
        lpips: nn.Module | None,
        psnr_only: bool = False,
        median_depths: Float[Tensor, "V H W"] | None = None,
    ) -> list[dict[str, float]]:
        """Compute the metrics of each view by itself, as SSIM of many takes much memory."""
        rows = []
        for view in range(targets.num_views):
            image, target = rendered[[view]], targets.select([view])
            if psnr_only:
                values = {"psnr": self.psnr(image, target)}
            else:
                values = self.image_metrics(image, target, lpips)
                if depths is not None:
                    median = None if median_depths is None else median_depths[[view]]
                    values |= self.depth_metrics(depths[[view]], target, median)
            rows += _rows(values)
        return rows

    def measure_baselines(
        self, inputs: Views, targets: Views, lpips: nn.Module | None, psnr_only: bool = False
    ) -> dict[str, list[dict[str, float]]]:
        """Compute the metrics of each of BASELINES, by name; see `measure_views`.

        And of DEPTH_BASELINES where the data has depths, without `psnr_only`.
        """
        baselines = {
            name: self.measure_views(draw(inputs, targets), None, targets, lpips, psnr_only)
            for name, (_, draw) in BASELINES.items()
        }
        if not psnr_only and inputs.depths is not None and targets.depths is not None:
            for name, (_, draw) in DEPTH_BASELINES.items():
                baselines[name] = _rows(self.depth_metrics(draw(inputs, targets), targets))
        return baselines

    def notes(self, lpips: nn.Module | None) -> dict[str, str]:
        """Return what results say of their metrics: protocol/<metric>, or missing/lpips: why."""
        notes = {f"protocol/{name}": text for name, text in self.describe().items()}
        if lpips is None:
            del notes["protocol/lpips"]
            notes["missing/lpips"] = self.without_lpips()
        return notes

    def describe(self) -> dict[str, str]:
        """Describe each metric, after the protocol's name."""
        size = metrics.SSIM_WINDOWS[self.ssim_window]
        window = f"{self.ssim_window} window {size}x{size}"
        if self.ssim_window == "gaussian":
            window = f"{window} sigma {metrics.SSIM_SIGMA}".replace("gaussian", "Gaussian")
        cut = " and cut to 8 bits" if self.eight_bit else ""
        images = f"RGB in [0, 1], rendering clamped{cut}"
        inside = " over the pixels of its mask" if self.psnr_over == "masks" else ""
        by_scene = self.mean_over == "scenes"
        mean = "mean over a scene's images, then over scenes" if by_scene else "mean over images"
        median = "depth of each view scaled to the true median"
        aligned = {"none": "depth not aligned", "median": median}[self.depth_alignment]
        pixels = "the pixels of a view that its mask includes and whose depth is known"
        error = f"mean of |d - t| / t over {pixels}"
        close = f"share with max(d/t, t/d) < {metrics.DELTA} of {pixels}"
        expected = "d the expected depth, sum w z / sum w over the Gaussians"
        half = (
            "d the median depth, z of the Gaussian that takes the transmittance to half or below, "
            "0, which counts as wrong, without one"
        )
        return {
            "name": self.name,
            "psnr": f"{images}, from each image's own MSE{inside} (at most 100 dB), {mean}",
            "ssim": f"{images}, {window}, data range 1, {self.ssim_covariance} covariance, "
            f"windows wholly inside the image, mean over channels, {mean}",
            "lpips": f"v0.1 with {BACKBONES[self.lpips_net]}, {images} and scaled to [-1, 1], "
            f"full resolution, {mean}",
            "absrel": f"{error}, {expected}, {aligned}, {mean}",
            "delta1": f"{close}, {expected}, {aligned}, {mean}",
            "absrel_median": f"{error}, {expected}, {median}, {mean}",
            "median_depth_absrel": f"{error}, {half}, {aligned}, {mean}",
            "median_depth_delta1": f"{close}, {half}, {aligned}, {mean}",
        }


def _rows(values: dict[str, PerView]) -> list[dict[str, float]]:
    """Turn the numbers of V views, by metric, into a row for each view."""
    views = zip(*(numbers.tolist() for numbers in values.values()), strict=True)
    return [dict(zip(values, row, strict=True)) for row in views]
