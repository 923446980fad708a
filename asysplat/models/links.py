"""How the branches exchange tokens, and which tokens Gaussians are predicted from."""

from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.attention import CrossAttention, SelfAttention
from asysplat.models.layers import StageShape


class FineToCoarse(CrossAttention):
    """C^s = CrossAttn(C~, F~): details for the geometry branch; attention has width d_f."""

    def __init__(self, coarse: StageShape, fine: StageShape):
        super().__init__(coarse, context_width=fine.width, inner_width=fine.width)


class CoarseToFine(nn.Module):
    """F^s = SelfAttn(CrossAttn(F~, C~)): depth cues for the appearance branch."""

    def __init__(self, coarse: StageShape, fine: StageShape):
        super().__init__()
        self.cross = CrossAttention(fine, context_width=coarse.width, inner_width=fine.width)
        self.attention = SelfAttention(fine)

    def forward(
        self, fine: Float[Tensor, "B V h w d"], coarse: Float[Tensor, "B V h2 w2 c"]
    ) -> Float[Tensor, "B V h w d"]:
        read = self.cross(fine, coarse)
        # With views in the batch, each view attends to itself alone.
        return self.attention(read.flatten(0, 1)[:, None]).view_as(read)


class NoLink(nn.Module):
    """No link: the branch keeps its own tokens."""

    def __init__(self, coarse: StageShape, fine: StageShape):
        super().__init__()

    def forward(self, reader: Tensor, read: Tensor) -> Tensor:
        return reader


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
