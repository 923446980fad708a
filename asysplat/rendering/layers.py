"""What a backend returns."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Layers:
    """Images without background, batch and views flattened.

    Args:
        image: [I, 3, H, W] sum of w_i c_i.
        alpha: [I, H, W] sum of w_i.
        transmittance: [I, H, W] 1 - alpha, but to float32's relative precision also where it is
            nearly 0.
        depth: [I, H, W] sum of w_i (z_i - depth_origin), or the depth of the Gaussian that takes
            the transmittance to half or below, 0 where none does; None unless asked for.
        depth_origin: [I, H, W] without a gradient, near the depths that are blended, so that their
            differences are not lost to rounding; None for 0.
        stats: counts of what was done and of what was skipped.
    """

    image: Float[Tensor, "I 3 H W"]
    alpha: Float[Tensor, "I H W"]
    transmittance: Float[Tensor, "I H W"]
    depth: Float[Tensor, "I H W"] | None
    stats: dict[str, int]
    depth_origin: Float[Tensor, "I H W"] | None = None
