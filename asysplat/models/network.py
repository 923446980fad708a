"""What every network that turns views into Gaussians has in common."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.errors import InputError
from asysplat.models.layers import Layers
from asysplat.models.prior import PRIOR_CHANNELS, Prior
from asysplat.models.shapes import Widths
from asysplat.models.tokenizer import PIXEL_CHANNELS, pixel_features
from asysplat.ops.precision import without_autocast
from asysplat.scene import Gaussians, Views


class Network(nn.Module, ABC):
    """Views -> Gaussians: checks sizes, takes any leading batch dimensions.

    Args:
        widths: of the network.
        patch: image pixels along a side of its largest token.
        prior: views and the size of the head's grid -> what is known of the surfaces; or None.
    """

    def __init__(self, widths: Widths, patch: int, prior: nn.Module | None):
        super().__init__()
        self.widths, self.patch, self.prior = widths, patch, prior

    def forward(self, views: Views) -> Gaussians:
        """Predict Gaussians [..., N] from views [..., V].

        Raises:
            InputError: image sides that are no multiples of `size_multiple`.
        """
        self.check_size(views.cameras.height, views.cameras.width)
        batch = views.images.shape[:-4]
        gaussians = self.predict(with_one_batch_dimension(views))
        return gaussians.map(lambda field: field.reshape(*batch, *field.shape[1:]))

    @abstractmethod
    def predict(self, views: Views) -> Gaussians:
        """Predict Gaussians [B, N] from views [B, V]."""

    @abstractmethod
    def geometry_share(self) -> float:
        """Return the share of parameters outside an appearance branch."""

    @property
    def pixel_channels(self) -> int:
        """The number of channels that a tokenizer sees of each pixel."""
        return PIXEL_CHANNELS + (0 if self.prior is None else PRIOR_CHANNELS)

    def look(self, views: Views, stride: int) -> tuple[Float[Tensor, "B V H W c"], Prior | None]:
        """Return what the tokenizers see of every pixel, and the prior on the head's grid."""
        if self.prior is None:
            return pixel_features(views, None), None
        cameras = views.cameras
        with torch.no_grad(), without_autocast(views.images):
            prior = self.prior(views, (cameras.height // stride, cameras.width // stride))
        return pixel_features(views, prior), prior

    def describe(self) -> str:
        """Return the sizes and what they come to, in a line."""
        total = sum(p.numel() for p in self.parameters())
        stages = "/".join(map(str, self.widths.stages))
        return (
            f"{total / 1e6:.2f}M parameters, {self.geometry_share():.1%} of them for geometry; "
            f"stages {stages} wide, heads {self.widths.head_dim}"
        )

    def checkpoint_layers(self, checkpointing: bool) -> None:
        """Choose whether the backward pass computes each layer again; see `Layers`."""
        for module in self.modules():
            if isinstance(module, Layers):
                module.checkpointing = checkpointing

    @property
    def size_multiple(self) -> int:
        """The number that image sides must be multiples of: the largest patch."""
        return self.patch

    def check_size(self, height: int, width: int) -> None:
        """Raise InputError unless both sides are multiples of `size_multiple`."""
        multiple = self.size_multiple
        if height % multiple or width % multiple:
            raise InputError(
                f"data.height x data.width is {height}x{width}, but this model takes multiples of "
                f"{multiple}, its patch: set {-(-height // multiple) * multiple}x"
                f"{-(-width // multiple) * multiple}, as the paper takes 540 to 544."
            )


def with_one_batch_dimension(views: Views) -> Views:
    """Flatten all leading batch dimensions into one: [..., V, ...] to [B, V, ...]."""
    dims = views.images.ndim - 4  # leading batch dimensions
    if dims == 1:
        return views
    if dims == 0:
        return views.map(lambda tensor: tensor[None])
    return views.map(lambda tensor: tensor.flatten(0, dims - 1))
