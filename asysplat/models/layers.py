"""What blocks are made of: shapes, norms, tokenizers and layers."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from asysplat.errors import InputError
from asysplat.kernels.dispatch import without_autocast
from asysplat.scene import Views


@dataclass(frozen=True)
class StageShape:
    """The sizes of every block of a network stage."""

    width: int  # d_s, or d_f in the appearance branch
    head_dim: int  # channels of one attention or Mamba2 head; divides every width
    mlp_ratio: int  # r_s, hidden over outer width of the stage's MLPs


@dataclass(frozen=True)
class Widths:
    """Every width of a model."""

    stages: tuple[int, ...]  # (d_1, d_2, d_3) of the geometry branch
    fine: int  # d_f of the appearance branch
    head_dim: int  # channels of one attention or Mamba2 head; divides all others

    def scaled(self, factor: float) -> "Widths":
        """Multiply the widths by `factor`; keep the number of heads, of at least 4 channels."""
        head_dim = max(4, round(self.head_dim * factor / 4) * 4)
        stages = tuple(width // self.head_dim * head_dim for width in self.stages)
        return Widths(stages, self.fine // self.head_dim * head_dim, head_dim)

    def stage_shapes(
        self, stage_ratios: Sequence[int], **per_stage: Sequence[object]
    ) -> list[StageShape]:
        """Return the shape of each stage; check that the options in `per_stage` are as many."""
        for name, values in {"stage_ratios": stage_ratios, **per_stage}.items():
            if len(values) != len(self.stages):
                raise InputError(
                    f"model.{name} has {len(values)} entries for {len(self.stages)} stages of "
                    "model.stage_widths: give one for each stage."
                )
        return [
            StageShape(width, self.head_dim, ratio)
            for width, ratio in zip(self.stages, stage_ratios, strict=True)
        ]


class RMSNorm(nn.RMSNorm):
    """RMSNorm in the input's type, to which the weights are rounded; sums are in fp32.

    If weights and inputs differ in type, torch does not use its fused kernel.
    """

    def __init__(self, width: int, eps: float = 1e-6):
        super().__init__(width, eps)

    def forward(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        with without_autocast(x):
            return F.rms_norm(x, self.normalized_shape, self.weight.to(x.dtype), self.eps)


PIXEL_CHANNELS = 9


def pixel_features(
    views: Views, unit: Float[Tensor, "B 1 1 1 1"] | float
) -> Float[Tensor, "B V H W 9"]:
    """Return RGB in [-1, 1], ray moment o x d and unit direction d of every pixel.

    The moment is in units of length `unit`.
    """
    origins, directions = views.cameras.rays()
    colors = rearrange(views.images, "b v c h w -> b v h w c") * 2 - 1
    return torch.cat((colors, torch.linalg.cross(origins / unit, directions), directions), dim=-1)


class Tokenizer(nn.Module):
    """Linear embedding of p x p patches of pixels, then LayerNorm, with or without a bias."""

    def __init__(self, patch: int, width: int, bias: bool = True):
        super().__init__()
        self.patch = patch
        self.embed = nn.Linear(PIXEL_CHANNELS * patch**2, width, bias=False)
        self.norm = nn.LayerNorm(width, bias=bias)

    def forward(self, pixels: Float[Tensor, "B V H W c"]) -> Float[Tensor, "B V h w d"]:
        patches = rearrange(
            pixels, "b v (h p) (w q) c -> b v h w (p q c)", p=self.patch, q=self.patch
        )
        return self.norm(self.embed(patches))


class Layers(nn.ModuleList):
    """Layers in sequence.

    With `checkpointing`, the backward pass computes each layer again, and only the tokens between
    layers stay in memory (Chen et al. 2016).
    """

    checkpointing = False

    def forward(self, tokens: Float[Tensor, "B V h w d"]) -> Float[Tensor, "B V h w d"]:
        for layer in self:
            if self.checkpointing and torch.is_grad_enabled():
                contexts = (nullcontext(), _without_running_means(layer))
                tokens = checkpoint(
                    layer, tokens, use_reentrant=False, context_fn=lambda c=contexts: c
                )
            else:
                tokens = layer(tokens)
        return tokens


@contextmanager
def _without_running_means(layer: nn.Module) -> Generator[None]:
    """Freeze the running means of BatchNorm: the layer has counted this batch already."""
    norms = [m for m in layer.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.momentum = 0.0
        if norm.num_batches_tracked is not None:
            norm.num_batches_tracked -= int(norm.training)
    try:
        yield
    finally:
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum
