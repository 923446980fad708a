"""Load ImageNet features for LPIPS and the perceptual loss from files on this machine.

Without the files, runs continue without LPIPS and that loss; nothing is downloaded unless asked.
"""

import pickle
from collections.abc import Sequence
from http.client import HTTPException
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError

Backbone = Literal["alexnet", "vgg16", "vgg19", "matconvnet_vgg19"]
# In torch's hub cache: torchvision's files, whose part after the dash is a hash, and Long-LRM's.
HUB_FILES = {
    "alexnet": "alexnet-owt-*.pth",
    "vgg16": "vgg16-*.pth",
    "vgg19": "vgg19-*.pth",
    "matconvnet_vgg19": "matconvnet_vgg19.pt",
}
# Converted by Long-LRM from vlfeat.org/matconvnet/pretrained; the hash is of its repository's file.
MATCONVNET_URL = (
    "https://huggingface.co/arthurhero/llrm_stuff/resolve/main/misc/matconvnet_vgg19.pt"
)
MATCONVNET_SHA256 = "c7bc9f4af1aea2134b40e6e9c894ce5902d940ac5766088cc3ab6eaa07fe5660"

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def find_backbone(
    name: Backbone, backbone_dir: Path | str | None, download: bool = False
) -> dict[str, Tensor] | None:
    """Load ImageNet weights of a network's convolutions: torchvision's, or MatConvNet's of VGG19.

    They are read from torch's hub cache or else from `<name>_features_fp16.pth` in `backbone_dir`,
    or downloaded into the cache if `download` allows it; else None. In fp32, they have the values
    of half precision, so that both files give the same numbers.
    """
    candidates = sorted(_hub_cache().glob(HUB_FILES[name]))
    if backbone_dir is not None:
        candidates.append(Path(backbone_dir) / f"{name}_features_fp16.pth")
    for path in candidates:
        if path.is_file():
            return _features(name, _read(name, path), path)
    return _features(name, _download(name), _hub_cache()) if download else None


def _hub_cache() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints"


def _read(name: str, path: Path) -> Any:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(
            f"{path} cannot be read as weights of {name}: delete it or copy it again."
        ) from error


def _download(name: str) -> dict[str, Tensor]:
    from torchvision.models import get_model_weights

    matconvnet = name == "matconvnet_vgg19"
    weights = None if matconvnet else get_model_weights(name).IMAGENET1K_V1
    url = MATCONVNET_URL if matconvnet else weights.url
    try:
        if not matconvnet:
            return weights.get_state_dict(progress=True, check_hash=True)
        file = _hub_cache() / HUB_FILES[name]
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(url, str(file), hash_prefix=MATCONVNET_SHA256)
        return _read(name, file)
    except (OSError, RuntimeError, HTTPException) as error:  # no network, no space, another hash
        raise InputError(
            f"{url} could not be downloaded ({error}): put it into {_hub_cache()} by other "
            "means, or leave paths.download out to go on without it."
        ) from error


def _features(name: str, state: object, source: Path) -> dict[str, Tensor]:
    with torch.device("meta"):
        expected = _layers(name).state_dict(prefix="features.")
    for key, tensor in expected.items():
        loaded = state.get(key) if isinstance(state, dict) else None
        if not isinstance(loaded, Tensor) or loaded.shape != tensor.shape:
            raise InputError(
                f"{source} has no {key} of shape {tuple(tensor.shape)}: "
                f"give ImageNet weights of {name}, as torchvision names them."
            )
    return {key: state[key].half().float() for key in expected}


def _layers(name: Backbone) -> nn.Sequential:
    """Build a network's convolutions; importing torchvision takes as long as torch."""
    from torchvision.models import get_model

    return get_model(name.removeprefix("matconvnet_")).features


class VGGFeatures(nn.Module):
    """Computes frozen activations of VGG16 or VGG19 (Simonyan and Zisserman 2015).

    Those of the layers `taps` of torchvision's `features`, of images in [0, 1] that are divided by
    `std` after ImageNet's mean color is subtracted.
    """

    def __init__(
        self,
        name: Backbone,
        weights: dict[str, Tensor],
        taps: Sequence[int],
        std: Sequence[float],
        mean_pooling: bool = False,
    ):
        super().__init__()
        # On meta, because torchvision would also fill 124 M classifier weights at random.
        with torch.device("meta"):
            layers = _layers(name)[: taps[-1] + 1]
        if mean_pooling:
            pooled = [isinstance(layer, nn.MaxPool2d) for layer in layers]
            layers = [nn.AvgPool2d(2) if p else x for p, x in zip(pooled, layers, strict=True)]
        self.taps, self.features = taps, nn.Sequential(*layers)
        state = {key: weights[f"features.{key}"] for key in self.features.state_dict()}
        self.features.load_state_dict(state, assign=True)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None])
        self.register_buffer("std", torch.tensor(std)[:, None, None])
        self.requires_grad_(False).eval()

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        x = (images - self.mean) / self.std
        activations = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.taps:
                activations.append(x)
        return activations
