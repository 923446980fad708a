"""The linear decoder from tokens to Gaussians (paper, Sec. 3.2, "Merging and Gaussian Prediction").

The paper fixes the 59 numbers of a Gaussian, not their activations. Ours make an untrained model
draw its input photographs at a middle distance, so that training starts from pictures: colours are
residuals to the photograph, sizes are in units of the pixel's footprint, distances logarithmic.
"""

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.ops.precision import without_autocast
from asysplat.scene import Cameras, Gaussians, Views

SH_C0 = 0.28209479177387814  # Y_0, so that colour = 0.5 + SH_C0 * sh_0


class GaussianHead(nn.Module):
    """LayerNorm and Linear: each token gives p_f x p_f Gaussians, one a pixel of the image
    downsampled by p_c / p_f.

    Args:
        width: d_3.
        patch_coarse, patch_fine: p_c, p_f.
        sh_degree: 0 to 3.
        near, far: distances along the ray lie between them, in units of the normalised scene.
        opacity_bias: logit of an untrained opacity.
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
        super().__init__()
        self.patch, self.stride = patch_fine, patch_coarse // patch_fine
        self.near, self.far = near, far
        self.opacity_bias, self.scale_bias = opacity_bias, scale_bias
        # position, quaternion, scale, opacity, spherical harmonics
        self.splits = (3, 4, 3, 1, 3 * (sh_degree + 1) ** 2)
        self.norm = nn.LayerNorm(width, bias=False)
        self.decode = nn.Linear(width, patch_fine**2 * sum(self.splits), bias=False)
        nn.init.normal_(self.decode.weight, std=1e-3)

    def forward(self, features: Float[Tensor, "B V h w d"], views: Views) -> Gaussians:
        raw = rearrange(
            self.decode(self.norm(features)),
            "b v h w (p q z) -> b v (h p) (w q) z",
            p=self.patch,
            q=self.patch,
        )
        with without_autocast(raw):
            return self._activate(raw.to(views.images.dtype), views)

    def _activate(self, raw: Float[Tensor, "B V h w z"], views: Views) -> Gaussians:
        position, quats, scales, opacities, sh = raw.split(self.splits, dim=-1)
        cameras = views.cameras.resized(*raw.shape[2:4])
        origins, directions = cameras.rays()
        # Long-LRM's mean of three position outputs, on a logarithmic range.
        fraction = position.mean(-1, keepdim=True).sigmoid()
        distance = self.near * (self.far / self.near) ** fraction
        scales = (scales + self.scale_bias).clamp(-5, 3).exp() * distance * footprint(cameras)
        identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
        sh = sh.unflatten(-1, (-1, 3))
        sh = torch.cat((sh[..., :1, :] + self._photograph(views), sh[..., 1:, :]), dim=-2)
        per_pixel = Gaussians(
            means=origins + distance * directions,
            quats=quats + identity,
            scales=scales,
            opacities=(opacities[..., 0] + self.opacity_bias).sigmoid(),
            sh=sh,
        )
        return per_pixel.map(lambda field: field.flatten(1, 3))

    def _photograph(self, views: Views) -> Float[Tensor, "B V h w 1 3"]:
        """The downsampled photographs as spherical harmonics of degree 0."""
        small = F.avg_pool2d(views.images.flatten(0, 1), self.stride).unflatten(
            0, views.images.shape[:2]
        )
        return (rearrange(small, "b v c h w -> b v h w 1 c") - 0.5) / SH_C0


def footprint(cameras: Cameras) -> Float[Tensor, "B V 1 1 1"]:
    """Width of a pixel at distance 1."""
    return (1 / cameras.intrinsics[..., 0, 0])[..., None, None, None]
