"""The training loss (paper, Suppl. A, Eq. 5). A term that is off costs nothing."""

import warnings
from collections.abc import Callable
from typing import Any

import torch.nn.functional as F
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.evaluation.metrics import ssim
from asysplat.training.disparity import InputDisparity, RenderedDisparity
from asysplat.training.perceptual import PerceptualDistance, vgg16
from asysplat.training.prediction import Prediction


class SplattingLoss(nn.Module):
    """MSE + lambda_p perceptual + lambda_d normalized-disparity SmoothL1, and two more terms.

    Ours is 1 - SSIM, which sharpens edges like the perceptual term, at little cost and without a
    network; Long-LRM's is the mean opacity, which removes useless Gaussians.

    Args:
        mse, perceptual, depth, ssim, opacity: weights of the terms; 0 turns a term off.
        perceptual_term, depth_term: constructors, called if the term's weight is not 0.
        allow_missing: turn off, with a warning, the perceptual term if its network is not on this
            machine, and the depth term if the data has neither disparities nor depths.

    Raises:
        InputError: all terms are off, or one is missing and that is not allowed; the depth term at
            the first batch.
    """

    def __init__(
        self,
        mse: float,
        perceptual: float,
        depth: float,
        ssim: float = 0.0,
        opacity: float = 0.0,
        perceptual_term: Callable[[], PerceptualDistance] = vgg16,
        depth_term: Callable[[], RenderedDisparity | InputDisparity] = RenderedDisparity,
        allow_missing: bool = True,
    ):
        super().__init__()
        self.mse, self.perceptual, self.depth = mse, perceptual, depth
        self.ssim, self.opacity = ssim, opacity
        self.allow_missing = allow_missing
        distance = None
        try:
            distance = perceptual_term() if perceptual else None
        except FileNotFoundError as error:
            self._report_missing(f"training.loss.perceptual={perceptual:g}: {error}")
        # A list hides the frozen network from checkpoints.
        self._perceptual_term = [] if distance is None else [distance]
        self._depth_term = depth_term() if depth else None
        if not (mse or self._perceptual_term or depth or ssim):
            raise InputError(
                "training.loss has no term that is on: give mse, ssim, perceptual or depth a "
                "weight above 0, and for perceptual alone its network (paths.download=true fetches "
                "it)."
            )
        self._depth_checked = False

    @property
    def needs_depth(self) -> bool:
        """Whether the loss needs rendered depth."""
        return self._depth_term is not None and self._depth_term.renders_depth

    def forward(self, prediction: Prediction, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Compute the weighted sum, as "loss", and each term that is on, unweighted."""
        targets = batch["targets"]
        terms, image = {}, targets.masked(prediction.rendering.image)
        if self.mse:
            terms["mse"] = F.mse_loss(image, targets.images)
        if self.ssim:
            terms["ssim"] = 1 - ssim(image, targets.images).mean()
        for distance in self._perceptual_term:
            terms["perceptual"] = distance.to(image.device)(image, targets.images)
        if self.opacity:
            terms["opacity"] = prediction.gaussians.opacities.mean()
        if self._depth_term is not None:
            depth = self._depth_term(prediction, batch)
            if depth is not None:
                terms["depth"] = depth
            elif not self._depth_checked:
                self._report_missing(
                    f"training.loss.depth={self.depth:g}: the data has neither disparities nor "
                    "depths; python -m asysplat.data.disparity estimates disparities"
                )
            self._depth_checked = True
        return {"loss": sum(getattr(self, name) * term for name, term in terms.items()), **terms}

    def _report_missing(self, reason: str) -> None:
        """Warn that the training goes on without a term, or refuse to."""
        if not self.allow_missing:
            raise InputError(f"{reason}, and allow_missing_losses=true trains without this term.")
        warnings.warn(f"{reason}. Training goes on without this term.", stacklevel=4)
