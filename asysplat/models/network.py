"""What every network that turns views into Gaussians has in common."""

from abc import ABC, abstractmethod

from torch import nn

from asysplat.errors import InputError
from asysplat.models.layers import Layers
from asysplat.models.shapes import Widths
from asysplat.scene import Gaussians, Views


class Network(nn.Module, ABC):
    """Views -> Gaussians: checks sizes, takes any leading batch dimensions.

    Args:
        widths: of the network.
        patch: image pixels along a side of its largest token.
    """

    def __init__(self, widths: Widths, patch: int):
        super().__init__()
        self.widths, self.patch = widths, patch

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
