"""From tensors to layers."""

from torch import Tensor

from asysplat.errors import InputError
from asysplat.rendering.layers import Layers
from asysplat.rendering.settings import Settings
from asysplat.scene import Cameras, Gaussians


def draw(
    gaussians: Gaussians, cameras: Cameras, settings: Settings, masks: Tensor | None = None
) -> Layers:
    """Gaussians [B, N] and cameras [B, V] to layers of B V images, float32.

    What it draws where `masks` is False has no meaning. Of `settings.skips` it takes all but rows,
    which its small tiles are not cut into.

    Raises:
        InputError: Triton is missing; tensors elsewhere than on a GPU, unless Triton interprets
            its kernels (TRITON_INTERPRET=1); more pairs of splat and tile than a list can number.
    """
    try:
        from asysplat.rendering.cuda.stages import INTERPRETED, run_stages
    except ImportError as error:
        raise InputError("render's backend 'cuda' needs triton: pip install triton.") from error
    if not (gaussians.means.is_cuda or INTERPRETED):
        raise InputError(
            f"render's backend is 'cuda' and its Gaussians are on {gaussians.means.device}: choose "
            "'auto', or move them with .to('cuda')."
        )
    return run_stages(gaussians, cameras, settings, masks)
