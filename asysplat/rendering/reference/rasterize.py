"""Alpha compositing in plain torch, on any device and in any float type.

Tiles with lists of similar length are padded and composited together, in groups that fit into the
processor's cache. The backward pass recomputes the forward pass, so only the inputs are saved.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.rendering.interface import BlendingLimits
from asysplat.rendering.reference.project import Splats
from asysplat.rendering.reference.tiles import TileLists

TILE = 4  # pixels a side
GROUP_ELEMENTS = 1 << 17  # (splat, pixel) pairs of one group: temporaries of 512 KiB


def rasterize(
    splats: Splats,
    values: Float[Tensor, "M C"],
    lists: TileLists,
    limits: BlendingLimits,
    median: bool = False,
) -> Float[Tensor, "T C P"]:
    """Composite sum_i w_i values_i at every pixel of every tile, front to back.

    w_i = alpha_i prod_{j<i} (1 - alpha_j), Kerbl et al. 2023. The P = size * size pixels of a tile
    go row by row. With `median`, the last value is that of the splat at which the transmittance
    falls to half or below; 0 where it never does.
    """
    packed = torch.cat((splats.xy, splats.whitening, splats.opacities[:, None], values), -1)
    # The last row is the padding, with opacity 0.
    packed = torch.nn.functional.pad(packed, (0, 0, 0, 1))
    return _Rasterize.apply(packed, lists, limits, median)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, packed: Tensor, lists: TileLists, limits: BlendingLimits, median: bool
    ) -> Tensor:
        ctx.save_for_backward(packed)
        ctx.lists, ctx.options = lists, (limits, median)
        pixels = lists.size**2
        out = packed.new_zeros(len(lists.lengths), packed.shape[1] - 6, pixels)
        for tiles, _, block in _blocks(packed, lists, ctx.options):
            out.index_copy_(0, tiles, block.forward())
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_output: Tensor) -> tuple[Tensor, None, None, None]:
        (packed,) = ctx.saved_tensors
        grad = torch.zeros_like(packed)
        for tiles, splats, block in _blocks(packed, ctx.lists, ctx.options):
            rows = block.backward(grad_output.index_select(0, tiles))
            # A CPU sums in a fixed order: the same bits every time.
            grad.index_add_(0, splats.flatten(), rows.flatten(0, 1))
        return grad, None, None, None


def _blocks(
    packed: Tensor, lists: TileLists, options: tuple[BlendingLimits, bool]
) -> Iterator[tuple[Tensor, Tensor, "_Block"]]:
    """Yield tiles [t], their splats [t, K] and block, about GROUP_ELEMENTS pairs at a time.

    Covers all tiles with splats, longest list first; shorter lists end in the padding.
    """
    padded = torch.nn.functional.pad(lists.splats, (0, 1), value=len(packed) - 1)
    starts = lists.lengths.cumsum(0) - lists.lengths
    lengths, order = torch.sort(lists.lengths, descending=True, stable=True)
    lengths = lengths.tolist()
    begin, end = 0, len(lengths) - lengths.count(0)
    while begin < end:
        longest = lengths[begin]
        size = max(1, GROUP_ELEMENTS // (longest * lists.size**2))
        tiles = order[begin : min(begin + size, end)]
        rank = torch.arange(longest, device=tiles.device)
        slots = torch.where(rank < lists.lengths[tiles, None], starts[tiles, None] + rank, -1)
        splats = padded[slots]
        rows = packed.index_select(0, splats.flatten()).unflatten(0, splats.shape)
        yield tiles, splats, _Block(rows, lists.origins(tiles), lists.size, *options)
        begin += size


def _zero_below(values: Tensor, gate: Tensor, limit: float) -> None:
    """Set values to 0 where gate < limit, in one vectorized pass."""
    below = torch.nextafter(gate.new_tensor(limit), gate.new_zeros(())).item()
    torch.ops.aten.threshold_backward.grad_input(values, gate, below, grad_input=values)


class _Block:
    """K depth-ordered splats on each of t tiles: alphas, weights and their gradients."""

    def __init__(
        self, packed: Tensor, origins: Tensor, size: int, limits: BlendingLimits, median: bool
    ):
        """Compute alphas [t, K, P] from packed [t, K, 6 + C] and origins [t, 2]."""
        self.limits, self.median = limits, median
        self.x, self.y, self.a, self.b, self.c, self.opacity = packed[..., :6].unbind(-1)
        self.values = packed[..., 6:]
        corner = origins[:, None].to(packed.dtype) + 0.5
        self.dx, self.dy = corner[..., 0] - self.x, corner[..., 1] - self.y
        # u = a dx + b dy and v = c dy are affine in the pixel: one small product each.
        step = torch.arange(size, dtype=packed.dtype, device=packed.device)
        j, i = (grid.flatten() for grid in torch.meshgrid(step, step, indexing="ij"))
        self.basis = torch.stack((torch.ones_like(i), i, j))
        self.u = torch.stack((self.a * self.dx + self.b * self.dy, self.a, self.b), -1) @ self.basis
        self.v = torch.stack((self.c * self.dy, self.c), -1) @ self.basis[::2]
        exponent = (self.u * self.u).addcmul_(self.v, self.v).mul_(-0.5)
        self.alpha = exponent.exp_().mul_(self.opacity[..., None]).clamp_max_(limits.alpha_max)
        _zero_below(self.alpha, self.alpha, limits.alpha_min)
        self.passing = 1 - self.alpha
        self.transmittance = self.passing.cumprod(1)  # behind each splat
        # It never grows: all behind the first splat below the limit is dropped too.
        _zero_below(self.alpha, self.transmittance, limits.transmittance_min)

    def weights(self) -> Tensor:
        """Compute alpha times the transmittance in front of each splat."""
        weights = self.alpha.clone()
        weights[:, 1:] *= self.transmittance[:, :-1]
        return weights

    def median_weights(self) -> Tensor:
        """Return 1 for the splat that takes the transmittance to half or below, else 0."""
        before = torch.nn.functional.pad(self.transmittance[:, :-1], (0, 0, 1, 0), value=1.0)
        crosses = (before > 0.5) & (self.transmittance <= 0.5) & (self.alpha > 0)
        return crosses.to(before.dtype)

    def forward(self) -> Tensor:
        """Composite the values: [t, C, P]."""
        if not self.median:
            return self.values.mT @ self.weights()
        blended = self.values[..., :-1].mT @ self.weights()
        return torch.cat((blended, self.values[..., -1:].mT @ self.median_weights()), 1)

    def backward(self, grad_output: Tensor) -> Tensor:
        """Compute the gradient of `packed` from that of the composited values, [t, C, P]."""
        weights = self.weights()
        grad_values = weights @ grad_output.mT
        values = self.values
        if self.median:
            grad_values[..., -1:] = self.median_weights() @ grad_output[:, -1:].mT
            values, grad_output = values[..., :-1], grad_output[:, :-1]
        share = weights * (values @ grad_output)  # each splat's share of grad_output . output
        light_behind = share.sum(1, keepdim=True) - share.cumsum(1)
        # alpha dL/dalpha; 0 where alpha is clamped.
        grad = share.addcmul_(light_behind, self.alpha / self.passing, value=-1)
        if bool((self.opacity >= self.limits.alpha_max).any()):
            grad.mul_(self.alpha < self.limits.alpha_max)
        u0, a, b = -(self.u.mul_(grad) @ self.basis.T).movedim(-1, 0)
        v0, c = -(self.v.mul_(grad) @ self.basis[::2].T).movedim(-1, 0)
        grad_opacity = grad.sum(-1) / self.opacity.clamp_min(self.limits.alpha_min)
        grads = (
            -self.a * u0,
            -self.b * u0 - self.c * v0,
            a + self.dx * u0,
            b + self.dy * u0,
            c + self.dy * v0,
            grad_opacity,
        )
        return torch.cat((torch.stack(grads, -1), grad_values), -1)
