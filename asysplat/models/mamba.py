"""The blocks that scan tokens: bidirectional Mamba2 and MambaVision."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.attention import MLP
from asysplat.models.layers import RMSNorm, StageShape
from asysplat.ops import conv_silu, selective_scan, ssd

MAMBA2_KERNEL, VISION_KERNEL = 4, 3  # tokens of a convolution
EXPAND = 2  # of Mamba2: inner width over width


class BiMamba2(nn.Module):
    """The letter m: x + out(forward(u) + backward(u)), u = in(RMSNorm(x)), all views one sequence.

    Mamba2 (Dao and Gu 2024), in both directions as in Vision Mamba (Zhu et al. 2024).

    Args:
        state_size: N, numbers of the state of each channel.
        eps: epsilon of its RMSNorms; 1e-5 in Dao and Gu's code, https://github.com/state-spaces/mamba.
    """

    def __init__(self, shape: StageShape, state_size: int = 256, eps: float = 1e-6):
        super().__init__()
        inner = EXPAND * shape.width
        heads = inner // shape.head_dim
        self.norm = RMSNorm(shape.width, eps)
        self.project = nn.Linear(shape.width, 2 * inner + 2 * state_size + heads, bias=False)
        self.directions = nn.ModuleList(
            Mamba2Direction(inner, heads, state_size, reverse, eps) for reverse in (False, True)
        )
        self.out = nn.Linear(inner, shape.width, bias=False)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w d"]:
        u = self.project(self.norm(tokens)).flatten(1, 3)
        forward, backward = (direction(u) for direction in self.directions)
        return tokens + self.out(forward + backward).view_as(tokens)


class Mamba2Direction(nn.Module):
    """One direction with its own convolution, scan parameters and gated RMSNorm."""

    def __init__(self, inner: int, heads: int, state_size: int, reverse: bool, eps: float):
        super().__init__()
        self.splits = (inner, inner + 2 * state_size, heads)
        self.state_size, self.reverse = state_size, reverse
        channels = inner + 2 * state_size
        self.conv = nn.Conv1d(channels, channels, MAMBA2_KERNEL, groups=channels)
        self.A_log = nn.Parameter(torch.empty(heads).uniform_(1, 16).log())
        self.D = nn.Parameter(torch.ones(heads))
        self.dt_bias = nn.Parameter(inverse_softplus(log_uniform(heads, 1e-3, 1e-1)))
        self.norm = RMSNorm(inner, eps)

    def forward(self, u: Float[Tensor, "B L u"]) -> Float[Tensor, "B L inner"]:
        z, xBC, dt = u.split(self.splits, dim=-1)
        # Each token with the MAMBA2_KERNEL - 1 tokens before it in scan order.
        weight, before = self.conv.weight[:, 0], MAMBA2_KERNEL - 1
        if self.reverse:
            weight, before = weight.flip(-1), 0
        xBC = conv_silu(xBC, weight, self.conv.bias, before)
        x, B, C = xBC.split((self.splits[0], self.state_size, self.state_size), dim=-1)
        dt = F.softplus(dt.float() + self.dt_bias)
        heads = x.unflatten(-1, (self.splits[2], -1))
        y = ssd(heads, dt, -self.A_log.exp(), B, C, self.D, reverse=self.reverse).flatten(-2)
        return self.norm(y * F.silu(z))


def log_uniform(count: int, low: float, high: float) -> Float[Tensor, " count"]:
    """Draw log-uniform numbers from low to high."""
    return torch.empty(count).uniform_(math.log(low), math.log(high)).exp()


def inverse_softplus(x: Float[Tensor, " count"]) -> Float[Tensor, " count"]:
    """Return the value whose softplus is x > 0."""
    return x + torch.log(-torch.expm1(-x))


class MambaVision(nn.Module):
    """x + mixer(LN x), then x + MLP(LN x), within each view (Hatamizadeh and Kautz 2025; Eq. 2)."""

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
        self.conv_scan, self.conv_gate = (
            nn.Conv1d(half, half, VISION_KERNEL, groups=half, bias=False) for _ in range(2)
        )
        self.x_proj = nn.Linear(half, dt_rank + 2 * state_size, bias=False)
        self.dt_proj = nn.Linear(dt_rank, half)
        self.A_log = nn.Parameter(torch.arange(1.0, state_size + 1).log().repeat(half, 1))
        self.D = nn.Parameter(torch.ones(half))
        self.out = nn.Linear(width, width, bias=False)
        with torch.no_grad():  # steps between 1e-3 and 1e-1 (Gu and Dao 2023, Sec. 3.6)
            self.dt_proj.bias.copy_(inverse_softplus(log_uniform(half, 1e-3, 1e-1)))

    def forward(self, sequences: Float[Tensor, "F L d"]) -> Float[Tensor, "F L d"]:
        x, gate = self.project(sequences).chunk(2, dim=-1)
        x = conv_silu(x, self.conv_scan.weight[:, 0], None, before=VISION_KERNEL // 2)
        gate = conv_silu(gate, self.conv_gate.weight[:, 0], None, before=VISION_KERNEL // 2)
        dt, B, C = self.x_proj(x).split(self.splits, dim=-1)
        dt = F.softplus(self.dt_proj(dt).float())
        y = selective_scan(x, dt, -self.A_log.exp(), B, C, self.D)
        return self.out(torch.cat((y, gate), dim=-1))
