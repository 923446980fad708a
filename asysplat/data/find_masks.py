"""The object in photographs without masks, found by a network: U2-Net-p, run by onnxruntime.

https://github.com/xuebinqin/U-2-Net
"""

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.scene import Views, decode

SIZE = (320, 320)  # pixels of the network's photographs and maps
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's, on which it was trained
LEAST = 1e-6  # least divisor, as for a black photograph


def load_object_finder() -> Callable[[Views], Views]:
    """Return a function that gives views the alphas of their object, and puts it on white."""
    package = find_spec("rembg")  # never imported: it is only where the weights are
    weights = Path(package.origin or "").with_name("u2netp.onnx") if package else Path()
    try:
        # Extra that is missing where types are checked.
        from onnxruntime import InferenceSession  # ty: ignore[import-not-found]
    except ImportError:
        weights = Path()
    if not weights.is_file():
        raise InputError(
            "masks=find needs onnxruntime and the weights of U2-Net-p: "
            "pip install 'asysplat[masks]'."
        )
    session = InferenceSession(str(weights), providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    mean, std = (torch.tensor(values)[:, None, None] for values in (MEAN, STD))

    def find_alpha(image: Float[Tensor, "3 H W"]) -> Float[Tensor, "H W"]:
        pixels = F.interpolate(image[None], SIZE, mode="bilinear", antialias=True)
        pixels = (pixels / pixels.amax().clamp_min(LEAST) - mean) / std
        alpha = torch.from_numpy(session.run(None, {name: pixels.numpy()})[0])
        alpha = (alpha - alpha.amin()) / (alpha.amax() - alpha.amin()).clamp_min(LEAST)
        alpha = F.interpolate(alpha, image.shape[1:], mode="bilinear")[0, 0]
        return (255 * alpha).round() / 255  # as files have it: what is nearly empty is empty

    def find_object(views: Views) -> Views:
        alphas = torch.stack([find_alpha(decode(image)) for image in views.images])
        white = views.with_images(lambda view, one: 1 - alphas[view] * (1 - one.images))
        return replace(white, alphas=alphas)

    return find_object
