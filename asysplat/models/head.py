"""The linear decoder from tokens to Gaussians (paper, Sec. 3.2, "Merging and Gaussian Prediction").

The paper gives the 59 numbers of a Gaussian, not their meaning; each head has its own.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.kernels.dispatch import without_autocast
from asysplat.scene import Gaussians, Views


class Decoded(NamedTuple):
    """What the decoder gives for each Gaussian; quats, scales and sh are any numbers."""

    depth_fraction: Float[Tensor, "B V h w 1"]  # in [0, 1], place in the head's range of distances
    quats: Float[Tensor, "B V h w 4"]
    scales: Float[Tensor, "B V h w 3"]
    opacities: Float[Tensor, "B V h w"]  # in [0, 1]
    sh: Float[Tensor, "B V h w K 3"]


class GaussianHead(nn.Module, ABC):
    """LayerNorm and Linear: each token gives p_f x p_f Gaussians.

    Each pixel of the image downsampled by p_c / p_f gets one, on the ray through its center.

    Args:
        width, patch_coarse, patch_fine: d_3, p_c, p_f.
        sh_degree: 0 to 3.
        opacity_bias: logit of an untrained opacity.
        std: standard deviation of the untrained weights.
    """

    def __init__(
        self,
        width: int,
        patch_coarse: int,
        patch_fine: int,
        sh_degree: int,
        opacity_bias: float,
        std: float,
    ):
        super().__init__()
        self.opacity_bias = opacity_bias
        self.patch, self.stride = patch_fine, patch_coarse // patch_fine
        # position, quaternion, scale, opacity, SH
        self.sh_bands = (sh_degree + 1) ** 2
        self.splits = (3, 4, 3, 1, 3 * self.sh_bands)
        self.norm = nn.LayerNorm(width, bias=False)
        self.decode = nn.Linear(width, patch_fine**2 * sum(self.splits), bias=False)
        nn.init.normal_(self.decode.weight, std=std)

    def forward(self, features: Float[Tensor, "B V h w d"], views: Views) -> Gaussians:
        """Decode Gaussians [B, V h p_f w p_f], row by row of view after view."""
        pattern, side = "b v h w (p q z) -> b v (h p) (w q) z", self.patch
        raw = rearrange(self.decode(self.norm(features)), pattern, p=side, q=side)
        with without_autocast(raw):
            raw = raw.to(views.images.dtype)
            position, quats, scales, opacities, sh = raw.split(self.splits, dim=-1)
            # The mean of three outputs, as in Long-LRM.
            depth_fraction = position.mean(-1, keepdim=True).sigmoid()
            opacities = (opacities[..., 0] + self.opacity_bias).sigmoid()
            sh = sh.unflatten(-1, (self.sh_bands, 3))
            decoded = Decoded(depth_fraction, quats, scales, opacities, sh)
            return self.activate(decoded, views).map(lambda field: field.flatten(1, 3))

    def unit(self, views: Views) -> Float[Tensor, "B 1 1 1 1"] | float:
        """Return the unit of length of the ray moments that the network reads."""
        return 1.0

    @abstractmethod
    def activate(self, raw: Decoded, views: Views) -> Gaussians:
        """Return Gaussians [B, V, h, w] from decoded numbers and the network's input views."""


class ResidualHead(GaussianHead):
    """Our own head, of residuals to the input images, which an untrained model renders unchanged.

    Training therefore starts from images. Colors are residuals to the downsampled image, sizes are
    in units of the pixel's footprint, distances logarithmic. The image bypasses both branches, so
    the appearance branch contributes less than in a head without it.

    Args:
        sh_degree: 0 to 3.
        near, far: distances along the ray lie between them, in units of the normalized scene.
        scale_bias: log of an untrained size, in pixel footprints.
    """

    def __init__(
        self,
        width: int,
        patch_coarse: int,
        patch_fine: int,
        sh_degree: int = 3,
        near: float = 0.1,
        far: float = 100.0,
        opacity_bias: float = 0.0,
        scale_bias: float = -0.5,
    ):
        super().__init__(width, patch_coarse, patch_fine, sh_degree, opacity_bias, std=1e-3)
        self.near, self.far, self.scale_bias = near, far, scale_bias

    def activate(self, raw: Decoded, views: Views) -> Gaussians:
        cameras = views.cameras.resized(*raw.opacities.shape[2:])
        origins, directions = cameras.rays()
        distance = self.near * (self.far / self.near) ** raw.depth_fraction
        pixel = (1 / cameras.intrinsics[..., 0, 0])[..., None, None, None]  # width at distance 1
        sizes = (raw.scales + self.scale_bias).clamp(-5, 3).exp()
        identity = raw.quats.new_tensor([1.0, 0.0, 0.0, 0.0])
        batch = views.images.shape[:2]
        small = F.avg_pool2d(views.images.flatten(0, 1), self.stride).unflatten(0, batch)
        dc = (rearrange(small, "b v c h w -> b v h w 1 c") - 0.5) / SH_C0
        sh = torch.cat((raw.sh[..., :1, :] + dc, raw.sh[..., 1:, :]), -2)
        return Gaussians(
            means=origins + distance * directions,
            quats=raw.quats + identity,
            scales=sizes * distance * pixel,
            opacities=raw.opacities,
            sh=sh,
        )


class LongLRMHead(GaussianHead):
    """The head of Long-LRM (Ziwen et al. 2025), with the values of its configs/7m1t_tm.yaml.

    Colors and sizes are direct, sizes in units of the scene and at most e^largest; the distance
    along the ray is linear from 0 to `farthest`. The unit, of ray moments too, is Long-LRM's, the
    largest coordinate of an input camera, which is 1/sqrt(3) to 1 in a normalized scene
    (`asysplat.data.normalize`: the farthest camera is at distance 1). It renders with a near plane
    at 0.01, as `asysplat.rendering` does, and a far one at 1e6, beyond every prediction.

    Args:
        farthest: greatest distance, in that unit.
        scale_bias, largest: logs of an untrained and of the largest size.
    """

    def __init__(
        self,
        width: int,
        patch_coarse: int,
        patch_fine: int,
        sh_degree: int = 3,
        farthest: float = 500.0,
        opacity_bias: float = -2.0,
        scale_bias: float = -6.9,
        largest: float = -1.2,
    ):
        super().__init__(width, patch_coarse, patch_fine, sh_degree, opacity_bias, std=0.02)
        self.farthest, self.scale_bias, self.largest = farthest, scale_bias, largest

    def unit(self, views: Views) -> Float[Tensor, "B 1 1 1 1"]:
        """Compute Long-LRM's unit of length: the largest coordinate of the views' cameras.

        It is at least 1/sqrt(3), the minimum in a normalized scene with different positions.
        """
        largest = views.cameras.centers.abs().amax((-2, -1))
        return largest.clamp_min(3**-0.5)[:, None, None, None, None]

    def activate(self, raw: Decoded, views: Views) -> Gaussians:
        origins, directions = views.cameras.resized(*raw.opacities.shape[2:]).rays()
        unit = self.unit(views)
        sizes = (raw.scales + self.scale_bias).clamp(max=self.largest).exp() * unit
        return Gaussians(
            means=origins + self.farthest * unit * raw.depth_fraction * directions,
            quats=raw.quats,
            # Ours: a size stays above 0 where the exponential underflows.
            scales=sizes.clamp_min(torch.finfo(sizes.dtype).tiny),
            opacities=raw.opacities,
            sh=raw.sh,
        )
