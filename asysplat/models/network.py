"""The base of every network from views to Gaussians."""

import math
from abc import ABC, abstractmethod
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn
from torch._subclasses.fake_tensor import is_fake

from asysplat.errors import InputError
from asysplat.models.head import GaussianHead
from asysplat.models.layers import Layers, Widths, pixel_features
from asysplat.ranges import Fraction, configured
from asysplat.scene import Gaussians, Views


@dataclass(frozen=True, config=configured("model.prune"))
class Prune:
    """Keep the most opaque Gaussians and a few of the rest, so that these learn too.

    The public settings are 0.6 and 0.1 (arthurhero/Long-LRM,
    configs/dl3dv_i540_32input_8target.yaml), the paper's Table 4 keeps half. There the rest is
    drawn at random; here it is evenly spaced by opacity, so that the same views give the same
    Gaussians.
    """

    prune_ratio: Annotated[float, Field(ge=0, lt=1)]  # fraction of the Gaussians to drop
    random_ratio: Fraction = 0.0  # fraction of the kept ones that is not chosen by opacity

    def __call__(self, gaussians: Gaussians) -> Gaussians:
        """Select among Gaussians [B, N], the same number in each scene."""
        count = gaussians.num_gaussians
        kept = max(1, int(count * (1 - self.prune_ratio)))
        if kept == count:
            return gaussians
        spaced = int(kept * self.random_ratio)
        opaque = kept - spaced
        order = gaussians.opacities.argsort(dim=-1, descending=True, stable=True)
        steps = torch.arange(spaced, device=order.device)
        ranks = opaque + steps * (count - opaque) // max(1, spaced)
        chosen = torch.cat((order[:, :opaque], order[:, ranks]), -1)
        rows = torch.arange(len(chosen), device=chosen.device)[:, None]
        return gaussians.map(lambda field: field[rows, chosen])


class Network(nn.Module, ABC):
    """Views -> Gaussians: checks sizes, takes any leading batch dimensions.

    Args:
        patch: pixels along a side of its largest patches; image sides must be multiples of it.
        prune: selects among the predicted Gaussians; None keeps all.
    """

    view_counts = (1, math.inf)  # least and greatest number of input views

    def __init__(self, patch: int, prune: Prune | None = None):
        super().__init__()
        self.patch, self.prune = patch, prune

    def forward(self, views: Views, prune: bool = True) -> Gaussians:
        """Predict Gaussians [..., N] from views [..., V]; all of them if not `prune`.

        Raises:
            InputError: image sides that are no multiples of `patch`, or a number of views outside
                `view_counts`; outside of training, invalid views.
        """
        self.check_size(views.cameras.height, views.cameras.width)
        self.check_views(views.num_views)
        if not (self.training or views.images.is_meta or is_fake(views.images)):
            views.validate("the network's views")  # in training the data module does
        views, batch = views.decoded(), views.images.shape[:-4]
        gaussians = self.predict(views.map(lambda x: x.reshape(-1, *x.shape[len(batch) :])))
        if prune:
            gaussians = self.select(gaussians)
        return gaussians.map(lambda field: field.reshape(*batch, *field.shape[1:]))

    def select(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians [B, N] that `prune` keeps."""
        return gaussians if self.prune is None else self.prune(gaussians)

    @abstractmethod
    def predict(self, views: Views) -> Gaussians:
        """Predict Gaussians [B, N] from views [B, V]."""

    def geometry_ratio(self) -> float:
        """Return the fraction of parameters outside an appearance branch: all."""
        return 1.0

    def describe(self) -> str:
        """Return the number of parameters, in a line."""
        return f"{sum(p.numel() for p in self.parameters()) / 1e6:.2f}M parameters"

    def checkpoint_layers(self, checkpointing: bool) -> None:
        """Switch activation checkpointing of all layers on or off; see `Layers`."""
        for module in self.modules():
            if isinstance(module, Layers):
                module.checkpointing = checkpointing

    def check_size(self, height: int, width: int) -> None:
        """Raise InputError unless both sides are multiples of `patch`."""
        patch = self.patch
        if height % patch or width % patch:
            raise InputError(
                f"the images are {height}x{width}, but this model takes multiples of "
                f"{patch}, its patch: set {-(-height // patch) * patch}x"
                f"{-(-width // patch) * patch} (height x width), as the paper takes 540 to 544."
            )

    def check_views(self, count: int) -> None:
        """Raise InputError unless `count` input views are in `view_counts`."""
        least, greatest = self.view_counts
        if not least <= count <= greatest:
            raise InputError(
                f"data.inputs: this model takes {least} to {greatest} input views and got {count}: "
                f"set data.inputs={least if count < least else greatest}, or take another model."
            )


class TokenNetwork(Network):
    """A network of tokens, which a head decodes to a grid of Gaussians for each view."""

    head: GaussianHead

    def __init__(self, widths: Widths, patch: int, prune: Prune | None = None):
        super().__init__(patch, prune)
        self.widths = widths

    def predict(self, views: Views) -> Gaussians:
        """Predict Gaussians [B, N] from views [B, V]; N = V h w, of the head's grid."""
        return self.head(self.tokens(pixel_features(views, self.head.unit(views))), views)

    @abstractmethod
    def tokens(self, pixels: Float[Tensor, "B V H W c"]) -> Float[Tensor, "B V h w d"]:
        """Compute the tokens that the head decodes from `pixel_features`."""

    def describe(self) -> str:
        """Return the number of parameters and the widths, in a line."""
        stages = "/".join(map(str, self.widths.stages))
        return (
            f"{super().describe()}, {self.geometry_ratio():.1%} of them for geometry; "
            f"stages {stages} wide, heads {self.widths.head_dim}"
        )
