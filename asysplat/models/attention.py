"""Attention blocks: full and sparse self-attention over all views, cross-attention within a view.

All are pre-norm with an MLP, bias-free, and apply RMSNorm to queries and keys (paper, Suppl. A),
except that full attention also exists without this norm: other systems have none.
"""

import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.layers import RMSNorm, StageShape
from asysplat.ops import grid_attention

MAX_GRID = 64  # each image is padded to a multiple of it, in tokens


class MLP(nn.Sequential):
    """Linear, GELU, Linear; the hidden layer is `ratio` times as wide."""

    def __init__(self, width: int, ratio: int, bias: bool = False):
        super().__init__(
            nn.Linear(width, ratio * width, bias=bias),
            nn.GELU(),
            nn.Linear(ratio * width, width, bias=bias),
        )


class QueryKeyNorm(nn.Module):
    """RMSNorm of queries and keys, shared by the heads."""

    def __init__(self, head_dim: int):
        super().__init__()
        self.query = RMSNorm(head_dim)
        self.key = RMSNorm(head_dim)

    def forward(self, q: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
        return self.query(q), self.key(k)


class SelfAttention(nn.Module):
    """x + o(attn(qkv(LN x))), then x + MLP(LN x), over the tokens at the same grid place."""

    def __init__(self, shape: StageShape, grid: int = 1, qk_norm: bool = True):
        super().__init__()
        self.grid, self.head_dim = grid, shape.head_dim
        self.norm = nn.LayerNorm(shape.width, bias=False)
        self.qkv = nn.Linear(shape.width, 3 * shape.width, bias=False)
        self.qk_norm = QueryKeyNorm(shape.head_dim) if qk_norm else None
        self.out = nn.Linear(shape.width, shape.width, bias=False)
        self.mlp_norm = nn.LayerNorm(shape.width, bias=False)
        self.mlp = MLP(shape.width, shape.mlp_ratio)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w d"]:
        q, k, v = self.qkv(self.norm(tokens)).unflatten(-1, (3, -1, self.head_dim)).unbind(-3)
        if self.qk_norm is not None:
            q, k = self.qk_norm(q, k)
        tokens = tokens + self.out(grid_attention(q, k, v, self.grid).flatten(-2))
        return tokens + self.mlp(self.mlp_norm(tokens))


class FullAttention(SelfAttention):
    """The letter t: every token attends to all tokens of all views."""

    def __init__(self, shape: StageShape, qk_norm: bool = True):
        super().__init__(shape, grid=1, qk_norm=qk_norm)


class SparseAttention(nn.Module):
    """The letter s: convolutions within a view, then attention within a grid place (Sec. 3.3).

    `grid` is p_g; only the convolutions connect the grid places of a view.
    """

    def __init__(self, shape: StageShape, grid: int = 2, conv_blocks: bool = True):
        super().__init__()
        if grid not in range(1, MAX_GRID + 1):
            raise InputError(
                f"model.blocks.s.grid={grid}: give a whole number from 1 to {MAX_GRID}."
            )
        # 32 channels of a convolution group at the paper's head_dim of 64
        group_width = max(1, shape.head_dim // 2)
        self.convs = ConvBlocks(shape.width, group_width) if conv_blocks else nn.Identity()
        self.attention = SelfAttention(shape, grid)

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w d"]:
        return self.attention(self.convs(tokens))


class ConvBlocks(nn.Module):
    """x + two of [grouped Conv 3x3, BatchNorm, GELU], on each view separately."""

    def __init__(self, width: int, group_width: int):
        super().__init__()
        groups = width // group_width
        self.blocks = nn.Sequential()
        for _ in range(2):
            conv = nn.Conv2d(width, width, 3, padding=1, groups=groups, bias=False)
            self.blocks.extend((conv, nn.BatchNorm2d(width), nn.GELU()))

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w d"]:
        maps = rearrange(tokens, "b v h w d -> (b v) d h w")
        return tokens + rearrange(self.blocks(maps), "(b v) d h w -> b v h w d", b=len(tokens))


class CrossAttention(nn.Module):
    """x + o(attn(q(LN x), kv(LN context))), then x + MLP(LN x), within each view."""

    def __init__(self, shape: StageShape, context_width: int, inner_width: int):
        super().__init__()
        self.head_dim = shape.head_dim
        self.norm = nn.LayerNorm(shape.width, bias=False)
        self.context_norm = nn.LayerNorm(context_width, bias=False)
        self.query = nn.Linear(shape.width, inner_width, bias=False)
        self.key_value = nn.Linear(context_width, 2 * inner_width, bias=False)
        self.qk_norm = QueryKeyNorm(shape.head_dim)
        self.out = nn.Linear(inner_width, shape.width, bias=False)
        self.mlp_norm = nn.LayerNorm(shape.width, bias=False)
        self.mlp = MLP(shape.width, shape.mlp_ratio)

    def forward(
        self, tokens: Float[Tensor, "B V h w d"], context: Float[Tensor, "B V h2 w2 c"]
    ) -> Float[Tensor, "B V h w d"]:
        q = self._heads(self.query(self.norm(tokens)))
        k, v = map(self._heads, self.key_value(self.context_norm(context)).chunk(2, dim=-1))
        q, k = self.qk_norm(q, k)
        read = rearrange(F.scaled_dot_product_attention(q, k, v), "n H l p -> n l (H p)")
        tokens = tokens + self.out(read.reshape(*tokens.shape[:-1], -1))
        return tokens + self.mlp(self.mlp_norm(tokens))

    def _heads(self, x: Tensor) -> Tensor:
        return rearrange(x, "b v h w (H p) -> (b v) H (h w) p", p=self.head_dim)
