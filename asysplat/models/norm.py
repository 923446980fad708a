"""RMSNorm (Zhang and Sennrich 2019) without autocast."""

from jaxtyping import Float
from torch import Tensor, nn

from asysplat.kernels.precision import without_autocast


class RMSNorm(nn.RMSNorm):
    """RMSNorm computed in the type of its weights, fp32, and returned in the input's.

    If weights and inputs differ in type, torch does not use its fused kernel.

    Args:
        width: size of the last dimension.
    """

    def __init__(self, width: int):
        super().__init__(width, eps=1e-6)

    def forward(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        with without_autocast(x):
            return super().forward(x.to(self.weight.dtype)).to(x.dtype)
