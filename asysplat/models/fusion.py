"""The tokens that Gaussians are predicted from (paper, Eq. 4 and Table 6a)."""

from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn


class FineTokens(nn.Module):
    """Conv 3x3 of the fine tokens with stride p_c / p_f, to the coarse grid."""

    def __init__(self, coarse_width: int, fine_width: int, stride: int):
        super().__init__()
        self.conv = nn.Conv2d(fine_width, coarse_width, 3, stride=stride, padding=1)

    def forward(
        self, coarse: Float[Tensor, "B V h w d"], fine: Float[Tensor, "B V h2 w2 c"]
    ) -> Float[Tensor, "B V h w d"]:
        maps = rearrange(fine, "b v h w d -> (b v) d h w")
        return rearrange(self.conv(maps), "(b v) d h w -> b v h w d", b=len(fine))


class FusedTokens(FineTokens):
    """O_out = C_out + Conv(F_out), Eq. 4."""

    def forward(
        self, coarse: Float[Tensor, "B V h w d"], fine: Float[Tensor, "B V h2 w2 c"]
    ) -> Float[Tensor, "B V h w d"]:
        return coarse + super().forward(coarse, fine)


class CoarseTokens(nn.Module):
    """The coarse tokens alone."""

    def __init__(self, coarse_width: int, fine_width: int, stride: int):
        super().__init__()

    def forward(
        self, coarse: Float[Tensor, "B V h w d"], fine: Float[Tensor, "B V h2 w2 c"]
    ) -> Float[Tensor, "B V h w d"]:
        return coarse
