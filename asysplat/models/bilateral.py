"""The bilateral connection between the branches, one component a link (paper, Eq. 3)."""

from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.attention import CrossAttention, SelfAttention
from asysplat.models.shapes import StageShape


class CoarseReadsFine(CrossAttention):
    """C^s = CrossAttn(C~, F~): details for the geometry branch; attention is d_f wide."""

    def __init__(self, coarse: StageShape, fine: StageShape):
        super().__init__(coarse, context_width=fine.width, inner_width=fine.width)


class FineReadsCoarse(nn.Module):
    """F^s = SelfAttn(CrossAttn(F~, C~)): depth cues for the appearance branch."""

    def __init__(self, coarse: StageShape, fine: StageShape):
        super().__init__()
        self.cross = CrossAttention(fine, context_width=coarse.width, inner_width=fine.width)
        self.attention = SelfAttention(fine)

    def forward(
        self, fine: Float[Tensor, "B V h w d"], coarse: Float[Tensor, "B V h2 w2 c"]
    ) -> Float[Tensor, "B V h w d"]:
        read = self.cross(fine, coarse)
        # Views move into the batch: each frame attends to itself alone.
        return self.attention(read.flatten(0, 1)[:, None]).view_as(read)


class NoLink(nn.Module):
    """No link: the branch goes on with its own tokens."""

    def __init__(self, coarse: StageShape, fine: StageShape):
        super().__init__()

    def forward(self, reader: Tensor, read: Tensor) -> Tensor:
        return reader
