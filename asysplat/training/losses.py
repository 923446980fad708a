"""The training objective (paper, Suppl. A, Eq. 5). A term that is off costs nothing."""

import warnings
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from asysplat.evaluation.backbones import VGGFeatures, find_backbone
from asysplat.rendering import Rendering
from asysplat.scene import Views

DISPARITY_STRIDE = 2  # p_c / p_f of the paper: both maps are downsampled by it
SEEN = 0.5  # where Gaussians cover less than this, their depth says nothing


class ReconstructionLoss(nn.Module):
    """MSE + lambda_p perceptual + lambda_d normalised-disparity SmoothL1.

    Args:
        mse, perceptual, depth: weights of the terms; 0 turns a term off. The perceptual term is
            also off where VGG16 is not on this machine (said once), the depth term where the data
            has no depths.
        weights: folder that may hold the VGG16 backbone.
        download: VGG16 where it is missing.
    """

    def __init__(
        self,
        mse: float,
        perceptual: float,
        depth: float,
        weights: str | None = None,
        download: bool = False,
    ):
        super().__init__()
        self.mse, self.perceptual, self.depth = mse, perceptual, depth
        # In a list, so that the frozen network stays out of the checkpoints.
        self._vgg: list[VGGFeatures] = []
        if perceptual:
            backbone = find_backbone("vgg16", None if weights is None else Path(weights), download)
            if backbone is None:
                warnings.warn(
                    "VGG16 is neither in torch's hub cache nor in paths.weights: "
                    "training goes on without the perceptual term; paths.download=true fetches it.",
                    stacklevel=2,
                )
            else:
                self._vgg.append(VGGFeatures(backbone))

    @property
    def needs_depth(self) -> bool:
        return self.depth > 0

    def forward(self, rendering: Rendering, targets: Views) -> dict[str, Tensor]:
        """The weighted sum under "loss", and each term that is on, unweighted."""
        terms, image = {}, targets.masked(rendering.image)
        if self.mse:
            terms["mse"] = F.mse_loss(image, targets.images)
        if self._vgg:
            terms["perceptual"] = self._perceptual(image, targets.images)
        if self.needs_depth and targets.depths is not None and rendering.depth is not None:
            terms["depth"] = disparity_loss(rendering.depth, rendering.alpha, targets.depths)
        return {"loss": sum(getattr(self, name) * term for name, term in terms.items()), **terms}

    def _perceptual(
        self, rendered: Float[Tensor, "*batch V 3 H W"], target: Float[Tensor, "*batch V 3 H W"]
    ) -> Float[Tensor, ""]:
        """Mean L1 distance of VGG16 features, over five depths (Chen and Koltun 2017)."""
        vgg = self._vgg[0].to(rendered.device)
        with torch.no_grad():
            expected = vgg(target.flatten(0, -4))
        found = vgg(rendered.flatten(0, -4))
        distances = [F.l1_loss(a, b) for a, b in zip(found, expected, strict=True)]
        return torch.stack(distances).mean()


def disparity_loss(
    depth: Float[Tensor, "*batch V H W"],
    alpha: Float[Tensor, "*batch V H W"],
    target: Float[Tensor, "*batch V H W"],
) -> Float[Tensor, ""]:
    """SmoothL1 between normalised disparities at 1 / DISPARITY_STRIDE of the resolution.

    Only pixels whose depth is known and which Gaussians cover count.
    """
    depth, alpha, target = (
        maps.flatten(0, -3)[:, ::DISPARITY_STRIDE, ::DISPARITY_STRIDE]
        for maps in (depth, alpha, target)
    )
    valid = (target > 0) & (alpha > SEEN) & (depth > 0)
    found, expected = (normalised_disparity(maps, valid) for maps in (depth, target))
    error = F.smooth_l1_loss(found, expected, reduction="none")
    return (error * valid).sum() / valid.sum().clamp_min(1)


def normalised_disparity(
    depth: Float[Tensor, "V H W"], valid: Bool[Tensor, "V H W"]
) -> Float[Tensor, "V H W"]:
    """1 / depth, less its median and over its mean absolute deviation, per view; 0 elsewhere."""
    disparity = torch.where(valid, 1 / torch.where(valid, depth, 1), torch.nan).flatten(1)
    median = disparity.nanmedian(dim=1, keepdim=True).values
    centered = torch.where(valid.flatten(1), disparity - median.nan_to_num(), 0)
    count = valid.flatten(1).sum(1, keepdim=True).clamp_min(1)
    deviation = centered.abs().sum(1, keepdim=True) / count
    return (centered / deviation.clamp_min(1e-6)).view_as(depth)
