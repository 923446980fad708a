"""Bidirectional Mamba2 (Dao and Gu 2024; both directions as in Vision Mamba, Zhu et al. 2024)."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.depthwise import depthwise_conv
from asysplat.models.layers import RMSNorm, StageShape
from asysplat.ops import ssd

CONV_KERNEL = 4
EXPAND = 2


class BiMamba2(nn.Module):
    """The letter m: x + out(forward(u) + backward(u)), u = in(RMSNorm(x)), all views one sequence.

    Args:
        state_size: N of the scan.
    """

    def __init__(self, shape: StageShape, state_size: int = 256):
        super().__init__()
        inner = EXPAND * shape.width
        heads = inner // shape.head_dim
        self.norm = RMSNorm(shape.width)
        self.project = nn.Linear(shape.width, 2 * inner + 2 * state_size + heads, bias=False)
        self.directions = nn.ModuleList(
            Mamba2Direction(inner, heads, state_size, reverse) for reverse in (False, True)
        )
        self.out = nn.Linear(inner, shape.width, bias=False)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w d"]:
        u = self.project(self.norm(tokens)).flatten(1, 3)
        mixed = sum(direction(u) for direction in self.directions)
        return tokens + self.out(mixed).view_as(tokens)


class Mamba2Direction(nn.Module):
    """One direction with its own convolution, scan parameters and gated RMSNorm."""

    def __init__(self, inner: int, heads: int, state_size: int, reverse: bool):
        super().__init__()
        self.splits = (inner, inner + 2 * state_size, heads)
        self.state_size, self.reverse = state_size, reverse
        channels = inner + 2 * state_size
        self.conv = nn.Conv1d(channels, channels, CONV_KERNEL, groups=channels)
        self.A_log = nn.Parameter(torch.empty(heads).uniform_(1, 16).log())
        self.D = nn.Parameter(torch.ones(heads))
        self.dt_bias = nn.Parameter(inverse_softplus(log_uniform(heads, 1e-3, 1e-1)))
        self.norm = RMSNorm(inner)

    def forward(self, u: Float[Tensor, "B L u"]) -> Float[Tensor, "B L inner"]:
        z, xBC, dt = u.split(self.splits, dim=-1)
        # Each token with the CONV_KERNEL - 1 tokens before it in scan order.
        weight, before = self.conv.weight, CONV_KERNEL - 1
        if self.reverse:
            weight, before = weight.flip(-1), 0
        xBC = F.silu(depthwise_conv(xBC, weight, self.conv.bias, before))
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
