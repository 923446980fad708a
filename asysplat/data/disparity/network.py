"""The monocular network Depth Anything (Yang et al. 2024), loaded with transformers."""

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import nn

from asysplat.errors import InputError

MODEL = "LiheYoung/depth-anything-small-hf"  # the weights that Long-LRM trains with; Apache-2.0
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # statistics of ImageNet, RGB
SHORT_SIDE = 518  # pixels of the shorter side in the network's training


class DepthAnything:
    """Estimates an image's disparity, up to scale and shift, with a network of transformers."""

    def __init__(self, network: nn.Module, device: torch.device):
        self.network, self.device = network.to(device).eval(), device
        config: Any = network.config  # transformers' own type
        self.patch_size: int = config.patch_size
        self.mean, self.std = (
            torch.tensor(rgb, device=device)[:, None, None] for rgb in (MEAN, STD)
        )

    @torch.inference_mode()
    def __call__(self, image: UInt8[ndarray, "h w 3"]) -> Float[ndarray, "H W"]:
        """Return the disparity of the whole image, at the network's own size."""
        # A copy, since arrays from Pillow are read-only.
        pixels = torch.tensor(image, device=self.device).permute(2, 0, 1)[None] / 255
        size = network_size(*image.shape[:2], self.patch_size)
        pixels = F.interpolate(pixels, size, mode="bicubic", antialias=True)
        output = self.network(pixel_values=(pixels - self.mean) / self.std)
        return output.predicted_depth[0].float().cpu().numpy()


def network_size(height: int, width: int, patch: int) -> tuple[int, int]:
    """Return the size in whole patches that is nearest to the image's proportions."""
    scale = SHORT_SIDE / min(height, width)
    rows, columns = (max(1, round(scale * side / patch)) for side in (height, width))
    return rows * patch, columns * patch


def load_depth_anything(model: str, download: bool) -> DepthAnything:
    """Load a network of relative depth with transformers."""
    try:
        # Extra that is missing where types are checked.
        from transformers import AutoModelForDepthEstimation  # ty: ignore[import-not-found]
    except ImportError as error:
        raise InputError(
            "python -m asysplat.data.disparity needs transformers: "
            "pip install 'asysplat[disparity]'."
        ) from error
    try:
        network = AutoModelForDepthEstimation.from_pretrained(
            model, local_files_only=not download, use_safetensors=True
        )
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"--model {model} cannot be loaded ({reason}): name a folder with config.json and "
            "model.safetensors, or let --download fetch it."
        ) from error
    kind = getattr(network.config, "depth_estimation_type", "relative")
    if kind != "relative":
        raise InputError(
            f"--model {model} estimates {kind} depth, not disparities: name a model of relative "
            f"depth, such as {MODEL}."
        )
    return DepthAnything(network, torch.device("cuda" if torch.cuda.is_available() else "cpu"))
