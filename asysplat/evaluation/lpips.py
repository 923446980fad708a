"""Compute LPIPS v0.1 (Zhang et al. 2018)."""

import warnings
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.evaluation.backbones import find_backbone
from asysplat.kernels.dispatch import without_autocast

MIN_SIDE = 32  # pixels


def load_lpips(
    net: Literal["alex", "vgg"], backbone_dir: Path | None, download: bool = False
) -> nn.Module | None:
    """Build the frozen LPIPS network; None if `find_backbone` does not find its backbone."""
    import lpips  # not above: it imports torchvision, which takes as long as torch

    backbone = find_backbone("alexnet" if net == "alex" else "vgg16", backbone_dir, download)
    if backbone is None:
        return None
    # On meta, because the package would initialize a whole torchvision model, 0.55 GB for VGG; the
    # warning is about an argument that it passes to torchvision.
    with torch.device("meta"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network = lpips.LPIPS(net=net, pretrained=False, pnet_rand=True, verbose=False)
    network.scaling_layer = lpips.ScalingLayer()
    # The package's slices keep torchvision's layer numbers: slice2.5.bias is features.5.bias.
    names = {key: "features." + key.split(".", 1)[1] for key in network.net.state_dict()}
    network.net.load_state_dict({k: backbone[name] for k, name in names.items()}, assign=True)
    path = Path(lpips.__file__).parent / "weights" / "v0.1" / f"{net}.pth"
    heads = torch.load(path, map_location="cpu", weights_only=True)
    heads = {key.removeprefix("lin"): tensor for key, tensor in heads.items()}
    network.lins.load_state_dict(heads, assign=True)
    return network.requires_grad_(False).eval()


def lpips_distance(
    network: nn.Module,
    rendered: Float[Tensor, "*batch V 3 H W"],
    target: Float[Tensor, "*batch V 3 H W"],
) -> Float[Tensor, "*batch V"]:
    """Compute LPIPS of each image in [0, 1] (`rendered` is clamped), of MIN_SIDE pixels or more.

    Images are compared one by one: VGG needs 1.5 GB for a pair of 540x960, AlexNet 0.2 GB.
    """
    pairs = zip(
        rendered.float().clamp(0, 1).flatten(0, -4), target.float().flatten(0, -4), strict=True
    )
    with without_autocast(rendered):
        distances = [network(a[None], b[None], normalize=True).squeeze() for a, b in pairs]
    return torch.stack(distances).reshape(rendered.shape[:-3])
