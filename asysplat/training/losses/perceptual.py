"""Perceptual distances of images, by frozen networks."""

import hashlib
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.evaluation.backbones import IMAGENET_STD, Backbone, VGGFeatures, find_backbone
from asysplat.kernels.dispatch import without_autocast


class PerceptualDistance(nn.Module):
    """Weighted sum, in fp32, of the mean absolute differences of frozen activations and images."""

    def __init__(self, features: VGGFeatures, weights: Sequence[float], image_weight: float):
        super().__init__()
        self.features, self.weights, self.image_weight = features, weights, image_weight

    @property
    def content(self) -> str:
        """Hash of the frozen weights, 16 digits."""
        digest = hashlib.sha256()
        for parameter in self.features.parameters():
            digest.update(parameter.detach().cpu().numpy())
        return digest.hexdigest()[:16]

    def forward(
        self, rendered: Float[Tensor, "*batch V 3 H W"], target: Float[Tensor, "*batch V 3 H W"]
    ) -> Float[Tensor, ""]:
        with without_autocast(rendered):
            with torch.no_grad():
                expected = self.features(target.flatten(0, -4))
            activations = self.features(rendered.flatten(0, -4))
            distance = self.image_weight * F.l1_loss(rendered, target)
            for weight, a, b in zip(self.weights, activations, expected, strict=True):
                distance = distance + weight * F.l1_loss(a, b)
            return distance


def vgg16(backbone_dir: str | None = None, download: bool = False) -> PerceptualDistance:
    """Build the mean over VGG16's ReLU 1_2, 2_2, 3_3, 4_3 and 5_3 (Johnson et al. 2016)."""
    backbone = _backbone("vgg16", backbone_dir, download)
    features = VGGFeatures("vgg16", backbone, taps=(3, 8, 15, 22, 29), std=IMAGENET_STD)
    return PerceptualDistance(features, weights=[1 / 5] * 5, image_weight=0.0)


LONG_LRM_WEIGHTS = (0.3846, 0.2083, 0.2703, 0.1786, 6.6667)  # 1/2.6, 1/4.8, 1/3.7, 1/5.6, 10/1.5
LONG_LRM_SCALE = 255.0


def longlrm(
    backbone_dir: str | None = None,
    download: bool = False,
    weights: Literal["matconvnet", "torchvision"] = "matconvnet",
) -> PerceptualDistance:
    """Build Long-LRM's distance (its public code's model/loss.py and configs/7m1t_tm.yaml).

    The weighted sum of Chen and Koltun 2017 over the images and VGG19's ReLU 1_2, 2_2, 3_2, 4_2 and
    5_2, with mean pooling in place of maximum pooling. Images, less ImageNet's mean, are scaled to
    [0, 255], and distances divided by 255. Long-LRM publishes MatConvNet's weights in these units.
    """
    name = "matconvnet_vgg19" if weights == "matconvnet" else "vgg19"
    backbone = _backbone(name, backbone_dir, download)
    std = (1 / LONG_LRM_SCALE,) * 3
    features = VGGFeatures(name, backbone, taps=(3, 8, 13, 22, 31), std=std, mean_pooling=True)
    scaled = [weight / LONG_LRM_SCALE for weight in LONG_LRM_WEIGHTS]
    return PerceptualDistance(features, scaled, image_weight=1.0)


def _backbone(name: Backbone, backbone_dir: str | None, download: bool) -> dict[str, Tensor]:
    backbone = find_backbone(name, backbone_dir, download)
    if backbone is None:
        raise FileNotFoundError(
            f"the weights of {name} are neither in torch's hub cache nor in paths.weights; "
            "paths.download=true fetches them"
        )
    return backbone
