"""The training loss (paper, Suppl. A, Eq. 5). A term that is off costs nothing."""

import warnings
from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.evaluation.metrics import ssim
from asysplat.training.losses.disparity import InputDisparity, LogDepth, RenderedDisparity
from asysplat.training.losses.perceptual import PerceptualDistance, vgg16
from asysplat.training.parallel import Batch, Prediction


class SplattingLoss(nn.Module):
    """MSE + lambda_p perceptual + lambda_d normalized-disparity SmoothL1, and two more terms.

    Ours is 1 - SSIM, which sharpens edges like the perceptual term, at little cost and without a
    network; Long-LRM's is the mean opacity, which removes useless Gaussians.

    Args:
        mse, perceptual, depth, ssim, opacity: weights of the terms; 0 turns a term off.
        allow_missing: turn off the depth term, with a warning, if the data has nothing for it.
    """

    def __init__(
        self,
        mse: float,
        perceptual: float,
        depth: float,
        ssim: float = 0.0,
        opacity: float = 0.0,
        perceptual_term: Callable[[], PerceptualDistance] = vgg16,
        depth_term: Callable[[], RenderedDisparity | InputDisparity | LogDepth] = RenderedDisparity,
        allow_missing: bool = True,
    ):
        super().__init__()
        self.mse, self.perceptual, self.depth = mse, perceptual, depth
        self.ssim, self.opacity, self.allow_missing = ssim, opacity, allow_missing
        # A list hides the frozen network from checkpoints.
        self._perceptual_term = [perceptual_term()] if perceptual else []
        self._depth_term = depth_term() if depth else None
        if not (mse or perceptual or depth or ssim):
            raise InputError(
                "training.loss has no term that is on: give mse, ssim, perceptual or depth a "
                "weight above 0."
            )
        self._depth_checked, self._depth_missing = False, False

    def describe(self) -> str:
        """Name the terms that ran: `1 mse, 0.5 perceptual (hash of its network), 0.01 depth`."""
        on = {name: getattr(self, name) for name in ("mse", "ssim", "opacity", "perceptual")}
        on["depth"] = 0 if self._depth_missing else self.depth
        terms = {name: f"{weight:g} {name}" for name, weight in on.items() if weight}
        for distance in self._perceptual_term:
            terms["perceptual"] += f" ({distance.content})"
        return ", ".join(terms.values())

    @property
    def needs_depth(self) -> bool:
        """Whether the loss needs rendered depth."""
        return self._depth_term is not None and self._depth_term.renders_depth

    def forward(self, prediction: Prediction, batch: Batch) -> dict[str, Tensor]:
        """Compute the weighted sum, as "loss", and each term that is on, unweighted."""
        terms, targets = {}, batch["targets"]
        image = targets.masked(prediction.rendering.image)
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
                self._depth_missing = True
                reason = f"training.loss.depth={self.depth:g}: {self._depth_term.missing}"
                report_missing(reason, self.allow_missing)
            self._depth_checked = True
        return {"loss": sum(getattr(self, name) * term for name, term in terms.items()), **terms}


def report_missing(reason: str, allowed: bool) -> None:
    """Warn that the training continues without a term of the loss."""
    if not allowed:
        raise InputError(f"{reason}, and allow_missing_losses=true trains without this term.")
    warnings.warn(f"{reason}. Training continues without this term.", stacklevel=4)
