"""The bilateral links between the branches (paper, Eq. 3)."""

from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.attention import CrossAttention, SelfAttention
from asysplat.models.shapes import StageShape


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
