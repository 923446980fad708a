"""MambaVision layer (Hatamizadeh and Kautz 2025), within each view (paper, Eq. 2)."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.attention import MLP
from asysplat.models.depthwise import depthwise_conv
from asysplat.models.layers import StageShape
from asysplat.models.mamba2 import inverse_softplus, log_uniform
from asysplat.ops import selective_scan

CONV_KERNEL = 3


class MambaVision(nn.Module):
    """x + mixer(LN x), then x + MLP(LN x).

    Args:
        state_size: N of the scan.
    """

    def __init__(self, shape: StageShape, state_size: int = 16):
        super().__init__()
        self.norm = nn.LayerNorm(shape.width)
        self.mixer = MambaVisionMixer(shape.width, state_size)
        self.mlp_norm = nn.LayerNorm(shape.width)
        self.mlp = MLP(shape.width, shape.mlp_ratio, bias=True)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w d"]:
        sequences = self.norm(tokens).flatten(2, 3).flatten(0, 1)
        tokens = tokens + self.mixer(sequences).view_as(tokens)
        return tokens + self.mlp(self.mlp_norm(tokens))


class MambaVisionMixer(nn.Module):
    """Scan half of the channels, only convolve the others, then mix both."""

    def __init__(self, width: int, state_size: int):
        super().__init__()
        half, dt_rank = width // 2, max(1, width // 16)
        self.splits = (dt_rank, state_size, state_size)
        self.project = nn.Linear(width, width, bias=False)
        self.conv_scan = self._conv(half)
        self.conv_gate = self._conv(half)
        self.x_proj = nn.Linear(half, dt_rank + 2 * state_size, bias=False)
        self.dt_proj = nn.Linear(dt_rank, half)
        self.A_log = nn.Parameter(torch.arange(1.0, state_size + 1).log().repeat(half, 1))
        self.D = nn.Parameter(torch.ones(half))
        self.out = nn.Linear(width, width, bias=False)
        with torch.no_grad():  # steps between 1e-3 and 1e-1 (Gu and Dao 2023, Sec. 3.6)
            self.dt_proj.bias.copy_(inverse_softplus(log_uniform(half, 1e-3, 1e-1)))

    @staticmethod
    def _conv(channels: int) -> nn.Conv1d:
        return nn.Conv1d(channels, channels, CONV_KERNEL, groups=channels, bias=False)

    def forward(self, sequences: Float[Tensor, "F L d"]) -> Float[Tensor, "F L d"]:
        x, gate = self.project(sequences).chunk(2, dim=-1)
        x = F.silu(depthwise_conv(x, self.conv_scan.weight, None, before=CONV_KERNEL // 2))
        gate = F.silu(depthwise_conv(gate, self.conv_gate.weight, None, before=CONV_KERNEL // 2))
        dt, B, C = self.x_proj(x).split(self.splits, dim=-1)
        dt = F.softplus(self.dt_proj(dt).float())
        y = selective_scan(x, dt, -self.A_log.exp(), B, C, self.D)
        return self.out(torch.cat((y, gate), dim=-1))
