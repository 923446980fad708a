"""The linear decoder from tokens to Gaussians (paper, Sec. 3.2, "Merging and Gaussian Prediction").

The paper fixes the 59 numbers of a Gaussian, not what they stand for: here are two readings.
"""

import math
from abc import ABC, abstractmethod

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.prior import Prior
from asysplat.ops.precision import without_autocast
from asysplat.rendering.sh import SH_C0
from asysplat.scene import Cameras, Gaussians, Views

# With a prior, corrections are bounded: on scenes unlike those of its training a network is wrong
# more often than the prior. Logits of places in the head's range and of opacity; logarithm of size.
FARTHEST = 0.01  # where the prior is not sure: more makes surfaces rough,
SURE = 0.3  # times that where it is
UNBOUNDED = 10.0  # in scenes of which it knows nothing
MOST_OPACITY = 0.5
MOST_SIZE = 1.0


class GaussianHead(nn.Module, ABC):
    """LayerNorm and Linear: each token gives p_f x p_f Gaussians.

    There is one for each pixel of the image downsampled by p_c / p_f, on the ray through that
    pixel's center.

    Args:
        width: d_3.
        patch_coarse, patch_fine: p_c, p_f.
        sh_degree: 0 to 3.
        opacity_bias: logit of an untrained opacity without a prior.
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

    def forward(
        self, features: Float[Tensor, "B V h w d"] | None, views: Views, prior: Prior | None = None
    ) -> Gaussians:
        """Decode Gaussians [B, V h p_f w p_f], row by row of view after view.

        With a prior, distances are corrections of its own, smaller where it is sure, and opacities
        of its own; without features nothing is corrected.
        """
        raw = self._nothing(views) if features is None else self._decoded(features)
        with without_autocast(raw):
            raw = raw.to(views.images.dtype)
            position, quats, scales, opacities, sh = raw.split(self.splits, dim=-1)
            # The mean of three outputs, as in Long-LRM.
            depth_logit = position.mean(-1, keepdim=True)
            opacities = opacities[..., 0]
            if prior is None:
                opacities = opacities + self.opacity_bias
            else:
                expected = self.depth_fraction(prior.distance).clamp(1e-4, 0.99).logit()
                bound = FARTHEST * (1 - (1 - SURE) * prior.confidence)
                bound = torch.where(prior.knows_something, bound, UNBOUNDED)
                depth_logit = (expected + bounded(depth_logit[..., 0], bound))[..., None]
                opacities = prior.opacity.logit() + bounded(opacities, MOST_OPACITY)
                scales = bounded(scales, MOST_SIZE)
            sh = sh.unflatten(-1, (-1, 3))
            gaussians = self.activate(
                depth_logit.sigmoid(), quats, scales, opacities.sigmoid(), sh, views
            )
            return gaussians.map(lambda field: field.flatten(1, 3))

    def _decoded(self, features: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h2 w2 z"]:
        return rearrange(
            self.decode(self.norm(features)),
            "b v h w (p q z) -> b v (h p) (w q) z",
            p=self.patch,
            q=self.patch,
        )

    def _nothing(self, views: Views) -> Float[Tensor, "B V h2 w2 z"]:
        size = (views.cameras.height // self.stride, views.cameras.width // self.stride)
        return views.images.new_zeros(()).expand(*views.images.shape[:2], *size, sum(self.splits))

    @abstractmethod
    def depth_fraction(self, distance: Float[Tensor, "B V h w"]) -> Float[Tensor, "B V h w"]:
        """Return where a distance is in the head's range, in [0, 1] if it is inside."""

    @abstractmethod
    def activate(
        self,
        depth_fraction: Float[Tensor, "B V h w 1"],
        quats: Float[Tensor, "B V h w 4"],
        scales: Float[Tensor, "B V h w 3"],
        opacities: Float[Tensor, "B V h w"],
        sh: Float[Tensor, "B V h w K 3"],
        views: Views,
    ) -> Gaussians:
        """Turn what was decoded into Gaussians [B, V, h, w].

        Args:
            depth_fraction: in [0, 1], where in the head's range of distances.
            opacities: in [0, 1].
            quats, scales, sh: any numbers.
            views: what the tokens were made of.
        """


class PhotographHead(GaussianHead):
    """Our own head: an untrained model draws its input photographs at a middle distance.

    Training therefore starts from pictures. Colors are residuals to the downsampled photograph,
    sizes are in units of the pixel's footprint, distances logarithmic. The photograph bypasses both
    branches: what the appearance branch adds is less than with colors of its own.

    Args:
        width, patch_coarse, patch_fine, sh_degree, opacity_bias: of GaussianHead.
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
        self.near, self.far = near, far
        self.scale_bias = scale_bias

    def depth_fraction(self, distance: Float[Tensor, "B V h w"]) -> Float[Tensor, "B V h w"]:
        return (distance / self.near).log() / math.log(self.far / self.near)

    def activate(
        self,
        depth_fraction: Float[Tensor, "B V h w 1"],
        quats: Float[Tensor, "B V h w 4"],
        scales: Float[Tensor, "B V h w 3"],
        opacities: Float[Tensor, "B V h w"],
        sh: Float[Tensor, "B V h w K 3"],
        views: Views,
    ) -> Gaussians:
        cameras = views.cameras.resized(*opacities.shape[2:])
        origins, directions = cameras.rays()
        distance = self.near * (self.far / self.near) ** depth_fraction
        identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
        return Gaussians(
            means=origins + distance * directions,
            quats=quats + identity,
            scales=(scales + self.scale_bias).clamp(-5, 3).exp() * distance * footprint(cameras),
            opacities=opacities,
            sh=torch.cat((sh[..., :1, :] + self._photograph(views), sh[..., 1:, :]), dim=-2),
        )

    def _photograph(self, views: Views) -> Float[Tensor, "B V h w 1 3"]:
        """Return the downsampled photographs as SH of degree 0."""
        small = F.avg_pool2d(views.images.flatten(0, 1), self.stride).unflatten(
            0, views.images.shape[:2]
        )
        return (rearrange(small, "b v c h w -> b v h w 1 c") - 0.5) / SH_C0


class LongLRMHead(GaussianHead):
    """The head of Long-LRM (Ziwen et al. 2025), with the values of its configs/7m1t_tm.yaml.

    Colors and sizes are direct, sizes in units of the scene and at most e^largest; the distance
    along the ray is linear from 0 to `farthest`. Lengths are those of the normalized scene, whose
    input cameras stand within radius 1 (`asysplat.data.normalize`); Long-LRM's stand in the box
    [-1, 1]^3, so its scenes are up to sqrt(3) times larger. It draws with a near
    plane at 0.01, as `asysplat.rendering` does, and a far one at 1e6, beyond all that is predicted.

    Args:
        width, patch_coarse, patch_fine, sh_degree, opacity_bias: of GaussianHead.
        farthest: distance, in units of the normalized scene.
        scale_bias: log of an untrained size.
        largest: log of the largest size.
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
        self.farthest = farthest
        self.scale_bias, self.largest = scale_bias, largest

    def depth_fraction(self, distance: Float[Tensor, "B V h w"]) -> Float[Tensor, "B V h w"]:
        return distance / self.farthest

    def activate(
        self,
        depth_fraction: Float[Tensor, "B V h w 1"],
        quats: Float[Tensor, "B V h w 4"],
        scales: Float[Tensor, "B V h w 3"],
        opacities: Float[Tensor, "B V h w"],
        sh: Float[Tensor, "B V h w K 3"],
        views: Views,
    ) -> Gaussians:
        origins, directions = views.cameras.resized(*opacities.shape[2:]).rays()
        sizes = (scales + self.scale_bias).clamp(max=self.largest).exp()
        return Gaussians(
            means=origins + self.farthest * depth_fraction * directions,
            quats=quats,
            # Ours: a size stays above 0 where the exponential underflows.
            scales=sizes.clamp_min(torch.finfo(sizes.dtype).tiny),
            opacities=opacities,
            sh=sh,
        )


def bounded(values: Tensor, bound: Tensor | float) -> Tensor:
    """Return numbers within the bound; those well inside it hardly change."""
    return bound * (values / bound).tanh()


def footprint(cameras: Cameras) -> Float[Tensor, "B V 1 1 1"]:
    """Return the width of a pixel at distance 1, in scene units."""
    return (1 / cameras.intrinsics[..., 0, 0])[..., None, None, None]
